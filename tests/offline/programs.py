"""The programs that the host's code builds for a row of tile sizes: noted while it computes small frames as if on a GPU."""

from dataclasses import dataclass

import numpy as np

from stss.frames.display_frame import window_at
from stss.frames.supersample import plan
from stss_cl.device import program
from stss_cl.device.discovery import open_device
from stss_cl.device.tuning import BUILT_IN, built_in_rows, trial
from stss_cl.network.network import PRECISIONS, Network
from stss_cl.skip.stream import SKIPS, Stream
from tests.cl.test_stream import WEIGHTS, first_frame, next_frame

SIZE = 19, 45
CHANGES = (*4 * ["nothing"], "moving", "moving", "pixel", "moving", "nothing", "rectangle")


@dataclass(frozen=True)
class Program:
    """A file of ``kernels/`` with the options it is built with and the kernels in it."""

    file: str
    options: tuple[str, ...]
    kernels: tuple[str, ...]

    @property
    def label(self):
        """The options that tell it from others of its file."""
        return " ".join(option for option in self.options if option != "-D" and not option.startswith("-cl-"))


def programs(row, *, network_only=False):
    """Those of one row of ``tuning.toml``, ``nvidia`` or ``amd`` for instance, in the order in which they are built.

    Args:
        row: its name.
        network_only: leave out what surrounds the network: the rest takes a minute of compiling for the device at hand.
    """
    device = open_device(device_class="gpu")
    with trial(built_in_rows(BUILT_IN)[0][row]):
        for precision in PRECISIONS:
            for size in ((32, 48), (544, 960)):  # of few tiles, and of many
                Network(WEIGHTS, device, precision).layers(*size)
            for skip in () if network_only else SKIPS:
                stream = Stream(WEIGHTS, device, precision, skip=skip, max_error=0.9 if skip == "bounded" else 0.0)
                for window, steps in _windows():
                    stream(window, steps)
    return [
        Program(
            file,
            tuple(options.replace(" -D EMULATE", "").split()),
            tuple(sorted(kernel.function_name for kernel in built.all_kernels())),
        )
        for (file, options), built in program.built(device).items()
    ]


def _windows():
    rng = np.random.default_rng(4)
    frames = [first_frame(rng, SIZE, rendered=True)]
    color = frames[0].color
    for i, change in enumerate(CHANGES, start=1):
        frame, color = next_frame(rng, frames[-1], color, change, rendered=i % 2 == 0)
        frames.append(frame)
    for i in range(len(frames)):
        window = window_at(frames, i)
        yield window, plan(window).steps
