# SPDX-License-Identifier: MIT
"""A module as a command: the user's mistakes are one line and status 2."""

from __future__ import annotations

import sys
from collections.abc import Callable

from stss.errors import InputError
from stss_ref.arrays import ArrayError
from stss_ref.weights import WeightsError


def command(main: Callable[[], None]) -> None:
    """Run ``main``."""
    try:
        main()
    except (InputError, ArrayError, WeightsError) as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
