# SPDX-License-Identifier: MIT
"""The network's buffers and launches for one frame size."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import Outgoing, Padded, constant, incoming, inputs_for, read, write
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil8, ceil_div
from stss_cl.device.launch import enqueue
from stss_cl.device.tuning import tuning_for
from stss_cl.network.conv import Final
from stss_cl.network.layer import LayerLaunch
from stss_cl.network.layer_builder import LayerBuilder, dtype_of
from stss_cl.network.pack_inputs import PackInputs
from stss_cl.network.pack_weights import pack_outc
from stss_cl.network.strips import OVERLAP, Strip, bytes_for, rows_within, strips, together_bytes
from stss_cl.network.tiles import Tiling, of_convolution, whole
from stss_ref.arrays import Array
from stss_ref.weights import SecondColor, Weights, colors_read, reads_history, second_color

GBUFFER, MASK = 9, 1
See = Callable[[LayerLaunch, tuple[Padded, int, int] | None], None]
WINDOW = 5
"""Side of the attention's window, in pixels at 1/8 size."""


class Layers:
    """Every launch of the network at (height, width), in order, with the buffers between them.

    A frame whose buffers would exceed the limit goes in strips: for each of ``strips``, ``place``, ``pack`` (or whatever else
    fills ``inputs``), ``run``.

    Args:
        device: to run on.
        weights: the 92 tensors.
        height: of the frame; padded to a multiple of 8 inside.
        width: likewise.
        precision: see ``stss_cl.network.network.PRECISIONS``.
        memory_limit: bytes that the buffers may take; None = half of the device's memory.
        residual: False: leave out all layers but the last, whose weights are 0.
        keep: every layer keeps its output, with a change map, so that fewer tiles may be run (``stss_cl.skip.partial_network``), and
            what does not depend on the frame is computed once; without effect where the frame goes in strips.

    Attributes:
        launches: in order; the last one writes the image.
        inputs: the inputs of the first launches.
        features: the stages' outputs, by the names of ``stss_ref``.
        strips: the strips in which the frame goes.
        keep: whether every layer's output is kept.
        reads_history: whether the launches read the history; those that do are left out with weights that do not.
        colors_read, second_color: of the weights, see ``stss_ref.weights``.
        marked: if all is kept, the output of each layer, with its change map.
        maps: those change maps.

    Raises:
        DeviceError: the limit is too small for any strip.
    """

    def __init__(
        self,
        device: Device,
        weights: Weights,
        height: int,
        width: int,
        precision: str,
        memory_limit: int | None = None,
        residual: bool = True,
        keep: bool = False,
    ):
        full, columns, dtype = ceil8(height), ceil8(width), dtype_of(precision)
        limit = int(device.handle.global_mem_size) // 2 if memory_limit is None else memory_limit
        winograd = precision != "float32-direct" and tuning_for(device).winograd is not None
        overlap = OVERLAP[winograd]
        rows = rows_within(full, columns, dtype, limit, overlap)
        keep = keep and bytes_for(full, full, columns, dtype, keep=True) <= limit
        self.device, self.size, self.keep = device, (height, width), keep
        self.reads_history, self.colors_read = reads_history(weights), colors_read(weights)
        self.second_color: SecondColor = second_color(weights)
        self._weights, self._height, self._width = weights, rows, columns
        self._fused = winograd
        self._local = tuning_for(device).local is not None and not device.is_cpu
        # The three images of the history in one launch, where that is known and their buffers have room.
        needed = bytes_for(rows, full, columns, dtype, keep=keep) + (0 if keep else together_bytes(rows, columns, dtype))
        self._together = self._local and not winograd and precision != "float32-direct" and needed <= limit
        self._build = LayerBuilder(device, weights, precision, rows, columns, keep)
        self.launches, self.marked, self.maps = self._build.launches, self._build.marked, self._build.maps
        self.strips = strips(full, height, rows, overlap)
        self._full, self._top = full, 0
        # Those that must know where a strip lies, with the divisor of their size.
        self._placed: list[tuple[LayerLaunch, int]] = []
        self.inputs = inputs_for(device, rows, columns, dtype, self.keep)
        self._build.share("two", 1, self.inputs.input)  # done with after the first layer
        self.features: dict[str, Padded] = {}
        if residual:
            self._encoder()
            self._history()
            self._erm()
            self._decoder()
        else:
            self._image(self.inputs.input)

    def ready(self, image: cl.Buffer) -> list[LayerLaunch]:
        """The launches in order; the last one writes ``image`` (2H, 2W, 3) float32."""
        self.launches[-1].set(image=image)
        return self.launches

    def run(self, image: cl.Buffer) -> None:
        """Enqueue the network; ``image`` is complete when the queue has run dry."""
        enqueue(self.device, self.ready(image))

    @cached_property
    def _packing(self) -> PackInputs:
        """Built when it is first asked for: stage ``prepare`` fills ``inputs`` itself."""
        return PackInputs(self.device, self.inputs, *self.size)

    def pack(self, color: cl.Buffer, gbuffer: cl.Buffer, mask: cl.Buffer, history: cl.Buffer | None) -> None:
        """Enqueue copying the inputs, plain arrays on the device, to the buffers of the first layers; ``history`` if it is read."""
        self._packing(color, gbuffer, mask, history if self.reads_history else None, self._top)

    def all_finite(self) -> bool:
        """Whether all inputs packed since the last call are finite; waits for the queue."""
        return self._packing.all_finite()

    def place(self, strip: Strip) -> None:
        """Make the launches compute this strip."""
        self._top = strip.top
        for launch, divisor in self._placed:
            launch.set(top=strip.top // divisor)
        last = self.launches[-1]
        tiles = whole(self.device, ceil_div(strip.last, 4), last.tiling.columns, strip.first // 4)
        last.set(first_row=strip.first, height=strip.last, top=strip.top, tiles=tiles.tiles, count=tiles.count)

    def layers_of(self, stage: str, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """What each layer of a stage, or of all (``network``), gives (docs/ports.md); the last one is fused where Winograd runs."""
        found: dict[str, list[Array]] = {}

        def see(launch: LayerLaunch, result: tuple[Padded, int, int] | None) -> None:
            if result is not None:
                out, first, n = result
                for i in range(launch.tiling.images):  # each an image of the output, or channels behind the one before it
                    place = (0, n, i) if out.images > 1 else (first + n * i, n, 0)
                    found.setdefault(launch.name, []).append(read(self.device, out, *place))
            elif launch.name in ("attend", "attend_local") and stage == "network":
                found["reshaded"] = [read(self.device, self.features["reshaded"], 0, 64)]

        if len(self.strips) > 1:
            return {}
        self.run_stage(stage, inputs, see)
        return {name: arrays[0] if len(arrays) == 1 else np.stack(arrays) for name, arrays in found.items()}

    def run_stage(self, stage: str, inputs: Mapping[str, Array], see: See | None = None) -> dict[str, Array]:
        """Run one stage alone, on arrays; H, W are multiples of 8 and the frame is one strip. ``see`` is told behind each launch."""
        height, width = self.size
        self.place(self.strips[0])
        color = inputs.get("color", np.zeros((height, width, 6), np.float32))
        gbuffer = inputs.get("gbuffer", np.zeros((height, width, 9), np.float32))
        mask = inputs.get("mask", np.zeros((height, width), np.float32))
        history = inputs.get("history", np.zeros((3, height, width, 4), np.float32))
        held = [incoming(self.device, array) for array in (color, gbuffer, mask, history)]
        self.pack(*held)
        for name in ("x1", "x2", "x3", "x4"):
            if name in inputs:
                write(self.device, self.features[name], inputs[name])
        if stage == "decoder":
            write(self.device, self.features["reshaded"], np.concatenate([inputs["reshaded"], inputs["feature"]], axis=-1))
        image = Outgoing(self.device, (2 * height, 2 * width, 3), on_device=False)
        for launch, result in zip(self.ready(image.data), self._build.results, strict=True):
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

    def _encoder(self) -> None:
        x = self._build.conv("encoder", "conv1", self.inputs.input, self._build.scratch("one", 1, 24), channels=(21,))
        x = self.features["x1"] = self._build.conv("encoder", "conv2", x, self._build.padded(1, 24))
        for i, (channels, divisor) in enumerate(((24, 2), (32, 4), (32, 8)), start=1):
            name = f"down{i}"
            x = self._build.conv(
                "encoder", f"{name}.downsample", x, self._build.scratch("one", divisor, x.channels), stride=2, relu=False
            )
            x = self._build.conv("encoder", f"{name}.conv1", x, self._build.scratch("two", divisor, channels))
            x = self._build.conv("encoder", f"{name}.conv2", x, self._build.padded(divisor, channels))
            self.features[f"x{i + 1}"] = x

    def _history(self) -> None:
        joined = self._build.padded(8, 96)
        self.features["reshaded"] = self._build.padded(8, 96)
        images = 3 if (together := self._together) else 1
        for image in ((None,) if together else range(3)) if self.reads_history else ():
            x = self.inputs.earlier
            for name, channels, divisor in (("convHis1", 24, 2), ("convHis2", 32, 4), ("convHis3", 32, 8)):
                one = self._build.scratch("one", divisor, channels, images)
                two = self._build.scratch("two", divisor, channels, images)
                which = None if together else 0
                x = self._build.conv("history", f"{name}.0", x, one, stride=2, image=image if divisor == 2 else which)
                x = self._build.conv("history", f"{name}.2", x, two, image=which)
                last = divisor == 8
                out = joined if last else self._build.scratch("one", divisor, channels, images)
                x = self._build.conv("history", f"{name}.4", x, out, out_first=32 * (image or 0) if last else 0, image=which)
        self._build.conv("history", "lowlevelGated", joined, self.features["reshaded"], relu=False, out_first=64)

    def _erm(self) -> None:
        options: dict[str, object] = {"KEYS": 32, "VALUES": 64}
        out, eighth = self.features["reshaded"], self.inputs.eighth
        light = self._build.conv(
            "erm", "latentEncoder.0", self.features["x4"], self._build.scratch("one", 8, 64), b=eighth, channels=(32, GBUFFER)
        )
        light = self._build.conv("erm", "latentEncoder.2", light, self._build.scratch("two", 8, 64))
        light = self._build.conv("erm", "latentEncoder.4", light, self._build.scratch("one", 8, 64), relu=False)
        key = self._build.conv("erm", "KEncoder.0", eighth, self._build.scratch("one", 8, 32), channels=(GBUFFER,))
        key = self._build.conv("erm", "KEncoder.2", key, self._build.scratch("two", 8, 32))
        key = self._build.conv("erm", "KEncoder.4", key, self._build.scratch("one", 8, 32), relu=False)
        if self._local:
            self._build.kernel(
                "erm", "attend_local", "attend_local.cl", options,
                {
                    "key": key.data, "value": light.data, "eighth": eighth.data, "reshaded": out.data,
                    "height": key.height, "width": key.width, "columns": light.columns, "out_channels": out.channels,
                },
                of_convolution(key.height, key.width, 1, WINDOW), workers=2 * light.channels, reads=(key, light, eighth), out=out,
            )  # fmt: skip
            return
        unit = self._build.scratch("two", 8, 32)
        self._build.kernel(
            "erm", "normalise", "erm.cl", options,
            {"key": key.data, "unit": unit.data, "height": key.height, "width": key.width, "columns": key.columns},
            of_convolution(key.height, key.width, 1, 1), reads=(key,), out=unit,
        )  # fmt: skip
        self._build.kernel(
            "erm", "attend", "erm.cl", options,
            {
                "unit": unit.data, "value": light.data, "eighth": eighth.data, "reshaded": out.data,
                "height": key.height, "width": key.width, "columns": light.columns, "out_channels": out.channels,
            },
            of_convolution(key.height, key.width, 1, WINDOW), reads=(unit, light, eighth), out=out,
        )  # fmt: skip

    def _decoder(self) -> None:
        x = self.features["reshaded"]
        for i, (middle, outputs, divisor) in enumerate(((64, 32, 4), (32, 24, 2), (24, 24, 1)), start=1):
            up = self._build.scratch("one", divisor, x.channels)
            # Rows 4 t .. 4 t + 3 of the output read the input's rows 2 t - 1 .. 2 t + 2.
            tiling = Tiling(ceil_div(up.height, 4), ceil_div(up.width, 4), (2, 2), 1, 0)
            launch = self._build.kernel(
                "decoder", "upsample_corners", "resample.cl", {},
                {
                    "in": x.data, "out": up.data, "height": x.height, "width": x.width, "in_columns": x.columns,
                    "out_columns": up.columns, "full_height": self._full // (2 * divisor), "top": 0, "eights": x.channels // 8,
                },
                tiling, reads=(x,), out=up,
            )  # fmt: skip
            self._placed.append((launch, 2 * divisor))
            skip = self.features[f"x{4 - i}"]
            name = f"up{i}.conv.double_conv"
            x = self._build.conv("decoder", f"{name}.0", skip, self._build.scratch("two", divisor, middle), b=up)
            if i == 3:
                self._last(f"{name}.2", x)
                return
            x = self._build.conv(
                "decoder", f"{name}.2", x, self._build.scratch("one", divisor, outputs), channels=(28 if i == 2 else middle,)
            )

    def _last(self, name: str, wide: Padded) -> None:
        """The last convolution and outc: in one launch where Winograd runs, else in two."""
        if self._fused:
            self._build.conv("decoder", name, wide, wide, final=self._final())
        else:
            self._image(self._build.conv("decoder", name, wide, self._build.scratch("one", 1, 24)))

    def _final(self) -> Final:
        weight, bias = (constant(self.device, array) for array in pack_outc(self._weights))
        return Final(self.inputs.base, weight, bias, self._height, self._width, *self.size, self.inputs.input.changes)

    def _image(self, feature: Padded) -> None:
        """Append outc and the upsampled frame; if outc is 0, any finite feature will do."""
        final = self._final()
        self._build.kernel(
            "decoder", "image", "decoder.cl", {},
            {
                "feature": feature.data, "color": final.color, "weight": final.weight, "bias": final.bias, "image": final.bias,
                "height": final.height, "width": final.width, "rows": final.rows, "columns": final.columns,
                "feature_columns": feature.columns, "first_row": 0, "top": 0,
            },
            of_convolution(final.height, final.width, 1, 3), reads=(feature, self.inputs.input), out=None,
        )  # fmt: skip
