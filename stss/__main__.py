# SPDX-License-Identifier: MIT
"""``python -m stss``."""

from stss.cli import main

main()
