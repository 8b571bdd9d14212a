# SPDX-License-Identifier: MIT
"""The program of `stss.devices.compilers`: compile for a device and a trial, back from a share of the kernels."""

import sys

from stss.devices.trial import SIZE, trial_weights
from stss_cl.device.discovery import open_device
from stss_cl.skip.stream import Stream


def main() -> None:
    """Take the three from the command line. Faults are left to the self-test."""
    name, trial, back_from = sys.argv[1:]
    Stream(trial_weights(trial), open_device(name)).expect(SIZE, float(back_from))


if __name__ == "__main__":
    main()
