# SPDX-License-Identifier: MIT
"""``python -m stss``, and ``stss``."""

import sys
from importlib import import_module


def main() -> None:
    """Run the command; Ctrl-C while it is imported ends it without a traceback."""
    try:
        if sys.argv[1:2] == ["conform"]:
            import_module("conformance")  # before NumPy, whose threads it sets
        from stss.cli.main import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
