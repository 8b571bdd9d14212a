"""The programs that the host's code builds for a row of tile sizes, as if it computed small frames on a GPU."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import pyopencl as cl
import pytest

from stss.frames.display_frame import halved, window_at
from stss.frames.supersample import plan
from stss_cl.device import matrix_units, program
from stss_cl.device.discovery import open_device
from stss_cl.device.tuning import BUILT_IN, built_in_rows, trial
from stss_cl.frame import Frame
from stss_cl.network.network import Network
from stss_cl.skip.stream import SKIPS, Stream
from tests.cl.conftest import QUICK
from tests.cl.test_stream import EARLIER, WEIGHTS, first_frame, next_frame

SIZE = 19, 45


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


def programs(row):
    """The programs of one row of ``tuning.toml``, such as ``nvidia`` or ``amd``, in the order in which they are built."""
    device = open_device(device_class="gpu")
    tuning = built_in_rows(BUILT_IN)[0][row]
    with trial(tuning), matrix_units.trial(row == "nvidia"), pytest.MonkeyPatch.context() as patch:
        matrix_units.proved(device)  # builds, and launches, what asks for them
        launch_nothing(patch)
        for precision in QUICK:
            for size in ((32, 48), (544, 960)):  # of few tiles, and of many
                Network(WEIGHTS, device, precision).layers(*size)
            for weights, skip in product((WEIGHTS, EARLIER), SKIPS):
                stream = Stream(weights, device, precision, skip=skip)
                for window, steps in _windows():
                    stream(window, steps)
                for cache in stream._caches.values():  # what only some frames build
                    cache.network.changed_tiles()
                    cache.prepare._whole  # noqa: B018
            Frame(WEIGHTS, device, precision)(**one_frame())
    return [
        Program(
            file,
            tuple(options.replace(" -D EMULATE", "").split()),
            tuple(sorted(kernel.function_name for kernel in built.all_kernels())),
        )
        for (file, options), built in program.built(device).items()
    ]


def launch_nothing(patch):
    """From now on, build kernels without running them: their results do not matter here, and processors take minutes for them."""
    patch.setattr(cl, "enqueue_nd_range_kernel", lambda queue, *_: cl.enqueue_marker(queue))
    patch.setattr(cl.Kernel, "__call__", lambda kernel, queue, *_, **__: cl.enqueue_marker(queue))


def one_frame():
    """The arguments of ``Frame``."""
    channels = {"colors": 3, "motions": 2, "normals": 3, "positions": 3}
    planes = {"colors": 3, "motions": 5, "normals": 4, "positions": 4}
    shapes = {name: (planes[name], *SIZE, count) for name, count in channels.items()}
    shapes |= {"gbuffer": (*SIZE, 9), "nov": SIZE, "stencils": (4, *SIZE)}
    return {"steps": (1, 3, 5), **{name: np.zeros(shape, np.float32) for name, shape in shapes.items()}}


def _windows():
    rng = np.random.default_rng(4)
    frames = [first_frame(rng, SIZE, rendered=True)]
    for i in range(1, 8):
        frames.append(next_frame(rng, frames[-1], frames[0].color, "nothing", rendered=i % 2 == 0)[0])
    frames[-1] = halved(frames[-1])
    for i in range(len(frames)):
        window = window_at(frames, i)
        yield window, plan(window).steps
