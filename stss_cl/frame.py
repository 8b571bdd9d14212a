# SPDX-License-Identifier: MIT
"""A whole display frame on an OpenCL device: from uploaded buffers to the image, with no transfer in between."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
from numpy.typing import NDArray

from stss_cl.device.buffers import Outgoing, Plain, mask_of, on_device
from stss_cl.device.discovery import Device
from stss_cl.image_space.frame_planes import Source, Sources
from stss_cl.image_space.prepare import Prepare, PrepareOptions
from stss_cl.network.layers import Layers
from stss_cl.network.network import Network
from stss_cl.options import Precision
from stss_ref.arrays import Array, require_finite, require_shape
from stss_ref.weights import Weights


class Frame:
    """Stage frame (spec 11), ready for one set of weights; buffers are made once for each size and reused.

    Args:
        weights: the 92 tensors.
        device: to run on; None = ``stss_cl.device.discovery.open_device()``.
        precision: see ``stss_cl.options.PRECISIONS``.
        memory_limit: see ``Network``.

    Raises:
        InputError: as ``Network``.
        DeviceError: as ``Network``.
    """

    def __init__(
        self,
        weights: Weights,
        device: Device | None = None,
        precision: Precision = "float32",
        memory_limit: int | None = None,
    ):
        self.network = Network(weights, device, precision, memory_limit)
        self.device, self.precision = self.network.device, precision
        self._prepare: Prepare | None = None

    def __call__(
        self,
        colors: Plain,
        steps: Sequence[int],
        motions: Plain,
        gbuffer: Plain,
        nov: Plain,
        stencils: Plain,
        normals: Plain,
        positions: Plain,
    ) -> tuple[Any, NDArray[np.bool_]]:
        """Compute one display frame.

        ``stss_ref.frame.FrameInputs`` gives units and ranges. All arrays are float32 and C-contiguous: NumPy arrays, or
        ``pyopencl.array`` of this device's context. Four planes are those of this frame, then of the three colour frames.

        Args:
            colors: (3, H, W, 3) display-referred, of the colour frames, newest first.
            steps: the distances of the three colour frames, in display frames back, newest first.
            motions: (k, H, W, 2) px, newest first, k at least the largest step.
            gbuffer: (H, W, 9) normal 3, depth, roughness, metallic, base colour 3.
            nov: (H, W) dot of normal and view vector.
            stencils: (4, H, W) object numbers.
            normals: (4, H, W, 3) world space.
            positions: (4, H, W, 3) cm.

        Returns:
            image: (2H, 2W, 3) float32, not clipped; a ``pyopencl.array`` if ``colors`` is one.
            valid: (H, W) False in the warping holes of the newest colour frame.

        Raises:
            ArrayError: shapes, dtypes or steps do not fit, or an array other than motions and positions is not finite. Planes of the two
                older colour frames are checked only if the weights read them.
        """
        stays = isinstance(colors, cla.Array)
        require_shape("gbuffer", gbuffer, (None, None, 9))
        height, width = gbuffer.shape[:2]
        layers = self.network.layers(height, width)
        prepare = self._preparation(layers)
        planes = {
            "colors": (colors, (3, height, width, 3)),
            "motions": (motions, (None, height, width, 2)),
            "gbuffer": (gbuffer, (height, width, 9)),
            "nov": (nov, (height, width)),
            "stencils": (stencils, (4, height, width)),
            "normals": (normals, (4, height, width, 3)),
            "positions": (positions, (4, height, width, 3)),
        }
        prepare.begin(steps=steps, **{name: self._source(name, array, shape) for name, (array, shape) in planes.items()})
        image = Outgoing(self.device, (2 * height, 2 * width, 3), on_device=stays)
        self._run(prepare, layers, image.data)
        result = image.finish()
        valid = mask_of(self.device, prepare.mask, (height, width), on_device=False).finish().view(np.bool_)
        name = prepare.not_finite()
        if name is not None:
            array = planes[name][0]
            require_finite(name, array.get() if isinstance(array, cla.Array) else array)
        return result, valid

    def expect(self, size: tuple[int, int]) -> None:
        """Build all kernels and buffers that ``start`` needs for planes of (height, width), and let the runtime compile or load them."""
        layers = self.network.layers(*size)
        self._preparation(layers).load()
        layers.load()

    def start(self, sources: Sources, size: tuple[int, int], image: cl.Buffer) -> cl.Buffer:
        """Enqueue the frame for planes of (height, width) that are on the device and known to be finite.

        Returns:
            The mask (H, W), uint8, until the next frame begins.
        """
        layers = self.network.layers(*size)
        prepare = self._preparation(layers)
        prepare.start(sources)
        self._run(prepare, layers, image)
        return prepare.mask

    def _source(self, name: str, array: Plain, shape: tuple[int | None, ...]) -> Source:
        if not isinstance(array, cla.Array):
            return array
        require_shape(name, array, shape)
        return on_device(self.device, name, array)

    def _preparation(self, layers: Layers) -> Prepare:
        if self._prepare is None or self._prepare.inputs is not layers.inputs:
            self._prepare = preparation(self.device, layers)
        return self._prepare

    def _run(self, prepare: Prepare, layers: Layers, image: cl.Buffer) -> None:
        for strip in layers.strips:
            prepare.strip(strip.top)
            layers.place(strip)
            layers.run(image)

    def timings(self) -> dict[str, float]:
        """Seconds of the network's stages, as ``Network.timings``."""
        return self.network.timings()


STAGES = frozenset({"frame"})
"""The stages that ``FrameStages`` runs."""


class FrameStages:
    """Stage ``frame`` by the names of the port protocol (docs/ports.md); arguments as of ``Frame``."""

    def __init__(self, weights: Weights, device: Device | None = None, precision: Precision = "float32"):
        self._frame = Frame(weights, device, precision)

    def run_stage(self, stage: str, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """Run one of ``STAGES``."""
        del stage
        names = ("colors", "motions", "gbuffer", "nov", "stencils", "normals", "positions")
        arrays = {name: np.ascontiguousarray(inputs[name], np.float32) for name in names}
        image, _ = self._frame(steps=[int(step) for step in inputs["steps"]], **arrays)
        return {"image": image}


def preparation(device: Device, layers: Layers) -> Prepare:
    """The image-space stages that fill the inputs of ``layers``, by the choices of its weights."""
    options = PrepareOptions(layers.second_color, layers.hole_test, layers.hole_fill, layers.colors_read, layers.reads_history)
    return Prepare(device, *layers.size, options, inputs=layers.inputs, tops=[strip.top for strip in layers.strips])
