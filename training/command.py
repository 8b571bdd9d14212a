# SPDX-License-Identifier: MIT
"""Run a module as a command: a user's mistake prints one line and ends with status 2."""

from __future__ import annotations

import sys
from collections.abc import Callable

import click

from stss_ground.errors import InputError
from stss_ref.arrays import ArrayError
from stss_ref.weights import WeightsError


def command(main: Callable[[], None]) -> None:
    """Run ``main``; an InputError prints one line and ends the process with status 2."""
    try:
        main()
    except (InputError, ArrayError, WeightsError) as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        sys.exit(130)
