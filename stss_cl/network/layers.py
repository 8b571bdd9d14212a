# SPDX-License-Identifier: MIT
"""The network's buffers and launches for one frame size."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, partial

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import BFLOAT16, FeatureMap, Outgoing, constant, incoming, inputs_for, read, write
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil8, ceil_div
from stss_cl.device.launch import enqueue
from stss_cl.device.parts import make_zeros
from stss_cl.device.tuning import tuning_for
from stss_cl.liveness import Live, colors_read, drop_tiny, find_live
from stss_cl.network.conv import Final
from stss_cl.network.layer import KernelSource, LayerLaunch
from stss_cl.network.layer_builder import LayerBuilder, dtype_of
from stss_cl.network.pack_inputs import PackInputs
from stss_cl.network.pack_weights import amx_outc, pack_outc
from stss_cl.network.plan import LAST, Attend, Conv, Plan, Upsample, plan_network
from stss_cl.network.strips import OVERLAP, Strip, bytes_for, rows_within, strips
from stss_cl.network.tiles import Tiling, of_convolution, whole
from stss_ref.arrays import Array
from stss_ref.constants import HoleFill, HoleTest
from stss_ref.weights import BY_NAME, SecondColor, Weights

See = Callable[[LayerLaunch, tuple[FeatureMap, int, int] | None], None]
WINDOW = 5
"""Side of the attention's window, in pixels at 1/8 size."""
SHARED, COLUMNS = 128, 64
"""Work-items of a GPU that share a tile of 32 x 4 pixels; columns of a tile of the image, with a work-item for each."""


class Layers:
    """Every launch of the network for one size of frame, in order, with the buffers between them.

    A frame whose buffers would exceed the limit is computed in strips: for each of ``strips``, ``place``, ``pack`` (or another way to fill
    ``inputs``), ``run``.

    Args:
        device: to run on.
        weights: the 92 tensors; tiny numbers are dropped (``stss_cl.liveness.drop_tiny``).
        size: (H, W) of the frame; padded to multiples of 8 inside.
        precision: see ``stss_cl.options.PRECISIONS``.
        memory_limit: bytes that the buffers may take; None = half of the device's memory.
        keep: every layer keeps its output, with a change map, so that fewer tiles may be run (``stss_cl.skip.partial_network``);
            without effect if the frame is computed in strips.
        every: every unit runs for each frame, even units that these weights do not need.

    Attributes:
        launches: in order, without layers that these weights do not need (``stss_cl.liveness.find_live``); the last one writes the image.
        once: launches whose result no frame changes; they have already run.
        inputs: the inputs of the first launches.
        features: the stages' outputs, by the names of ``stss_ref``.
        strips: the strips of the frame.
        keep: whether every layer's output is kept.
        reads_history: whether the launches read the history.
        colors_read, second_color, hole_test, hole_fill: of the weights, see ``stss_ref.weights``.
        marked: if all is kept, the output of each layer, with its change map.
        maps: those change maps; None: nothing is kept.

    Raises:
        DeviceError: the limit is too small for any strip.
    """

    def __init__(
        self,
        device: Device,
        weights: Weights,
        size: tuple[int, int],
        precision: str,
        memory_limit: int | None = None,
        keep: bool = False,
        every: bool = False,
    ):
        weights, (height, width) = drop_tiny(weights), size
        full, columns, dtype = ceil8(height), ceil8(width), dtype_of(precision)
        limit = device.memory // 2 if memory_limit is None else memory_limit
        winograd = precision in ("float32", "half") and tuning_for(device).winograd is not None
        overlap = OVERLAP[winograd]
        rows = rows_within(full, columns, dtype, limit, overlap)
        keep = keep and bytes_for(full, full, columns, dtype, keep=True) <= limit
        local = tuning_for(device).local is not None and not device.is_cpu
        live = find_live(weights)
        subset = Live(BY_NAME, (), weights) if every else live
        make_plan = partial(
            plan_network, subset.layers, subset.once, keep=keep, fused=winograd or precision == "bfloat16", local=local
        )
        # The three images of the history in one launch, if there is a kernel for that and their buffers have room.
        plan = make_plan(together=local and not winograd and precision in ("float32", "half"))
        if bytes_for(rows, full, columns, dtype, keep=keep, plan=plan) > limit:
            plan = make_plan(together=False)
        self.device, self.size, self.keep = device, size, keep
        self.reads_history, self.colors_read = subset.reads_history, colors_read(weights, live)
        self.second_color: SecondColor = weights.second_color
        self.hole_test: HoleTest = weights.hole_test
        self.hole_fill: HoleFill = weights.hole_fill
        self._needed, self._full, self._top = subset, full, 0
        self._strip: Strip | None = None
        self.inputs = inputs_for(device, rows, columns, dtype, keep)
        self._build = build = LayerBuilder(device, subset.tensors, precision, plan.slots, self.inputs)
        self.marked, self.maps = build.marked, build.maps
        self.features = {name: build[slot] for name, slot in plan.features.items()}
        self.strips = strips(full, height, rows, overlap)
        # The launches that need the place of a strip, with the divisor of their size.
        self._placed: list[tuple[LayerLaunch, int]] = []
        for step in (*plan.once, *plan.steps):
            if isinstance(step, Conv):
                build.conv(step)
            elif isinstance(step, Upsample):
                self._upsample(step)
            else:
                self._attend(step)
        self._image(plan)
        self.once, self.launches = build.launches[: len(plan.once)], build.launches[len(plan.once) :]
        enqueue(device, self.once)

    def ready(self, image: cl.Buffer) -> list[LayerLaunch]:
        """The launches in order; the last one writes ``image`` (2H, 2W, 3) float32."""
        self.launches[-1].set(image=image)
        return self.launches

    def run(self, image: cl.Buffer) -> None:
        """Enqueue the network; ``image`` is complete when the queue is empty."""
        enqueue(self.device, self.ready(image))

    def load(self) -> None:
        """Let the runtime load or compile all kernels, by launches over empty lists."""
        none, self._strip = make_zeros(self.device, 4), None
        for launch in self.launches:
            launch.load(self.device.queue, count=none)

    @cached_property
    def _packing(self) -> PackInputs:
        """Built at its first use: stage ``prepare`` fills ``inputs`` without it."""
        return PackInputs(self.device, self.inputs, *self.size)

    def pack(self, color: cl.Buffer, gbuffer: cl.Buffer, mask: cl.Buffer, history: cl.Buffer | None) -> None:
        """Enqueue copying the inputs, plain arrays on the device, to the buffers of the first layers; ``history`` if it is read."""
        self._packing(color, gbuffer, mask, history if self.reads_history else None, self._top)

    def all_finite(self) -> bool:
        """Whether all inputs packed since the last call are finite; waits for the queue."""
        return self._packing.all_finite()

    def place(self, strip: Strip) -> None:
        """Make the launches compute this strip."""
        if strip == self._strip:
            return
        self._strip, self._top = strip, strip.top
        for launch, divisor in self._placed:
            launch.set(top=strip.top // divisor)
        last = self.launches[-1]
        tiles = whole(self.device, ceil_div(strip.last, 4), last.tiling.columns, strip.first // 4)
        last.set(first_row=strip.first, height=strip.last, top=strip.top, tiles=tiles.tiles, count=tiles.count)

    def layers_of(self, stage: str, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """The result of each layer of a stage, or of all (``network``; docs/ports.md); the last one is fused if Winograd runs."""
        results: dict[str, list[Array]] = {}

        def see(launch: LayerLaunch, result: tuple[FeatureMap, int, int] | None) -> None:
            if result is not None:
                out, first, n = result
                for i in range(launch.tiling.images):  # each an image of the output, or channels behind the one before it
                    place = (0, n, i) if out.images > 1 else (first + n * i, n, 0)
                    results.setdefault(launch.name, []).append(read(self.device, out, *place))
            elif launch.name in ("attend", "attend_local") and stage == "network":
                results["reshaded"] = [read(self.device, self.features["reshaded"], 0, 64)]

        if len(self.strips) > 1:
            return {}
        self.run_stage(stage, inputs, see)
        return {name: arrays[0] if len(arrays) == 1 else np.stack(arrays) for name, arrays in results.items()}

    def run_stage(self, stage: str, inputs: Mapping[str, Array], see: See | None = None) -> dict[str, Array]:
        """Run one stage alone, on arrays; H, W are multiples of 8 and the frame is one strip. ``see`` is called after each launch."""
        height, width = self.size
        self.place(self.strips[0])
        color = inputs.get("color", np.zeros((height, width, 6), np.float32))
        gbuffer = inputs.get("gbuffer", np.zeros((height, width, 9), np.float32))
        mask = inputs.get("mask", np.zeros((height, width), np.float32))
        history = inputs.get("history", np.zeros((3, height, width, 4), np.float32))
        buffers = [incoming(self.device, array) for array in (color, gbuffer, mask, history)]
        self.pack(*buffers)
        for name in ("x1", "x2", "x3", "x4"):
            if name in inputs:
                write(self.device, self.features[name], inputs[name])
        if stage == "decoder":
            write(self.device, self.features["reshaded"], np.concatenate([inputs["reshaded"], inputs["feature"]], axis=-1))
        image = Outgoing(self.device, (2 * height, 2 * width, 3), on_device=False)
        for launch, result in zip((*self.once, *self.ready(image.data)), self._build.results, strict=True):
            if stage in (launch.stage, "network"):
                launch.enqueue(self.device.queue)
                if see is not None:
                    see(launch, result)
        outputs = {
            "encoder": {"x1": ("x1", 0, 24), "x2": ("x2", 0, 24), "x3": ("x3", 0, 32), "x4": ("x4", 0, 32)},
            "history": {"feature": ("reshaded", 64, 32)},
            "erm": {"reshaded": ("reshaded", 0, 64)},
        }
        if stage in ("decoder", "network"):
            return {"image": image.finish()}
        image.finish()
        return {name: read(self.device, self.features[key], first, n) for name, (key, first, n) in outputs[stage].items()}

    def _attend(self, step: Attend) -> None:
        key, value, out, eighth = self._build[step.key], self._build[step.value], self._build[step.out], self.inputs.eighth
        options: dict[str, object] = {"KEYS": key.channels, "VALUES": value.channels}
        size = {"height": key.height, "width": key.width, "columns": key.columns}
        window = of_convolution(key.height, key.width, 1, WINDOW)
        result = {"value": value.data, "eighth": eighth.data, "reshaded": out.data, **size, "out_channels": out.channels}
        if step.unit is None:
            self._build.kernel(
                "erm", KernelSource("attend_local.cl", "attend_local", options), {"key": key.data, **result},
                window, workers=2 * value.channels, reads=(key, value, eighth), out=out,
            )  # fmt: skip
            return
        unit = self._build[step.unit]
        self._build.kernel(
            "erm", KernelSource("erm.cl", "normalise", options), {"key": key.data, "unit": unit.data, **size},
            of_convolution(key.height, key.width, 1, 1), reads=(key,), out=unit,
        )  # fmt: skip
        self._build.kernel(
            "erm", KernelSource("erm.cl", "attend", options), {"unit": unit.data, **result}, window, reads=(unit, value, eighth), out=out
        )  # fmt: skip

    def _upsample(self, step: Upsample) -> None:
        x, up = self._build[step.source], self._build[step.out]
        # Rows 4 t .. 4 t + 3 of the output read the input's rows 2 t - 1 .. 2 t + 2.
        tiling = Tiling(ceil_div(up.height, 4), ceil_div(up.width, 32), (2, 16), 1, 0)
        launch = self._build.kernel(
            "decoder",
            KernelSource("resample.cl", "upsample_corners", {"EIGHTS": x.channels // 8, "PREFETCH": self.device.takes_prefetch}),
            {
                "in": x.data, "out": up.data, "height": x.height, "width": x.width, "in_columns": x.columns,
                "out_columns": up.columns, "full_height": self._full // step.source.divisor, "top": 0,
            },
            tiling, workers=SHARED, reads=(x,), out=up,
        )  # fmt: skip
        self._placed.append((launch, step.source.divisor))

    def _image(self, plan: Plan) -> None:
        """The image: by the last convolution itself, or from its result; if outc is 0, from any finite activations."""
        outc, bias = pack_outc(self._needed.tensors)
        full = self.inputs.input
        outc = amx_outc(outc) if plan.fused and full.dtype == BFLOAT16 else outc
        weight, bias = constant(self.device, outc), constant(self.device, bias)
        final = Final(self.inputs.base, weight, bias, full.height, full.width, *self.size, full.changes)
        if plan.fused:
            layer = self._needed.layers[LAST]
            self._build.conv(Conv(layer, ((plan.last, layer.inputs),), plan.last), final)
            return
        feature = self._build[plan.last]
        small, large = (
            of_convolution(final.height, final.width, 1, 3),
            Tiling(ceil_div(final.height, 4), ceil_div(final.width, COLUMNS), (4, COLUMNS), 1, 0),
        )
        self._build.kernel(
            "decoder", KernelSource("decoder.cl", "image", {}),
            {
                "feature": feature.data, "color": final.color, "weight": final.weight, "bias": final.bias,
                "height": final.height, "width": final.width, "rows": final.rows, "columns": final.columns,
                "feature_columns": feature.columns, "first_row": 0, "top": 0,
            },
            small if self.device.is_cpu else large,
            workers=COLUMNS, reads=(feature, full), out=None,
        )  # fmt: skip
