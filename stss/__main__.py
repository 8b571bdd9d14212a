# SPDX-License-Identifier: MIT
"""``python -m stss``."""

from stss.cli.main import main

main()
