"""The programs that the host's code builds for a row of tile sizes, as if it computed small frames on a GPU."""

from functools import cache
from itertools import product
from typing import NamedTuple

import pytest

from stss_cl.device import matrix_units, program
from stss_cl.device.discovery import open_device
from stss_cl.device.tuning import BUILT_IN, built_in_rows, trial
from stss_cl.frame import Frame
from stss_cl.network.network import Network
from stss_cl.options import SKIPS
from stss_cl.skip.stream import Stream
from tests.cl.conftest import QUICK, launch_nothing
from tests.cl.films import DETAILED, WEIGHTS, calls_of, film, frame_inputs, halve

SIZE = 19, 45


class Program(NamedTuple):
    """A file of ``kernels/`` with the options it is built with and the kernels in it."""

    file: str
    options: tuple[str, ...]
    kernels: tuple[str, ...]

    @property
    def label(self):
        """The options that tell it from others of its file."""
        return " ".join(option for option in self.options if option != "-D" and not option.startswith("-cl-"))


@cache  # to build them for the device at hand takes minutes
def programs(row):
    """The programs of one row of ``tuning.toml``, such as ``nvidia`` or ``amd``, in the order in which they are built."""
    device = open_device(device_class="gpu")
    tuning, frames = built_in_rows(BUILT_IN).classes[row], film(7 * ["nothing"], SIZE)
    frames[-1] = halve(frames[-1])
    with trial(tuning), matrix_units.trial(row == "nvidia"), pytest.MonkeyPatch.context() as patch:
        matrix_units.prove(device)  # builds, and launches, what asks for them
        launch_nothing(patch)
        for precision in QUICK:
            for size in ((32, 48), (544, 960)):  # of few tiles, and of many
                Network(WEIGHTS, device, precision).layers(*size)
            for weights, skip in product((WEIGHTS, DETAILED), SKIPS):
                stream = Stream(weights, device, precision, skip=skip)
                for call in calls_of(frames):
                    stream(*call)
            Frame(WEIGHTS, device, precision)(**vars(frame_inputs(SIZE)))
    return [
        Program(
            file,
            tuple(options.replace(" -D EMULATE", "").split()),
            tuple(sorted(kernel.function_name for kernel in program_of_file.handle.all_kernels())),
        )
        for (file, options), program_of_file in program.programs_of(device).items()
    ]
