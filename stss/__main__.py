# SPDX-License-Identifier: MIT
"""``python -m stss``, and ``stss``."""

import signal
import sys


def main() -> None:
    """Run the command; Ctrl-C while it is imported ends it without a traceback."""
    try:
        if sys.argv[1:2] == ["conform"]:
            from stss_ground.one_thread import take_one_thread

            take_one_thread()
        if sys.argv[1:2] in (["conform"], ["port"]):
            from stss_ground.freed_memory import keep_freed_memory

            keep_freed_memory()
        from stss.cli.main import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        # The command has ended. A second Ctrl-C would break off what Python does at its end, with a traceback.
        signal.signal(signal.SIGINT, signal.SIG_IGN)


if __name__ == "__main__":
    main()
