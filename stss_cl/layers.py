# SPDX-License-Identifier: MIT
"""The network's buffers and launches for one frame size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl

from stss_cl.buffers import Outgoing, Padded, constant, incoming, inputs_for, padded, read, write
from stss_cl.changes import ChangedOnly, Maps, kept_bytes
from stss_cl.device import Device
from stss_cl.launch import (
    FAST_MULTIPLY_ADD,
    HEIGHT_ARGUMENT,
    IMAGE_ARGUMENT,
    ROW_ARGUMENTS,
    Final,
    Launch,
    Skip,
    conv,
    half,
    span,
)
from stss_cl.pack_inputs import PackInputs
from stss_cl.packing import ceil8, ceil_div, pack, pack_outc
from stss_cl.program import build
from stss_cl.strips import OVERLAP, Strip, rows_within, strips
from stss_cl.tuning import tuning_for
from stss_ref.arrays import Array
from stss_ref.weights import Weights

GBUFFER, MASK = 9, 1


class Layers:
    """Every launch of the network at (height, width), in order, with the buffers between them.

    A frame whose buffers would exceed the limit goes in strips: for each of ``strips``, ``place``, ``pack`` (or whatever else
    fills ``inputs``), ``run``.

    Args:
        device: to run on.
        weights: the 92 tensors.
        height: of the frame; padded to a multiple of 8 inside.
        width: likewise.
        precision: see ``stss_cl.network.PRECISIONS``.
        memory_limit: bytes that the buffers may take; None = half of the device's memory.
        residual: False: leave out all layers but the last, whose weights are 0.
        keep: every layer keeps what it wrote, so that ``run_changed`` can be had; without effect where the frame goes in strips.

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
        self.size = height, width
        self.launches: list[Launch] = []
        self._device, self._weights = device, weights
        self._winograd = precision != "float32-direct"
        self._dtype = np.dtype(np.float16 if precision == "half" else np.float32)
        self._full, self._width = ceil8(height), ceil8(width)
        limit = int(device.handle.global_mem_size) // 2 if memory_limit is None else memory_limit
        overlap = OVERLAP[self._winograd and tuning_for(device).winograd is not None]
        self._height = rows_within(self._full, self._width, self._dtype, limit, overlap)
        self.strips = strips(self._full, height, self._height, overlap)
        self._top = 0
        # Kernels that must know where a strip lies: which of their arguments, and the divisor of their size.
        self._placed: list[tuple[cl.Kernel, int, int]] = []

        self.keep = keep and kept_bytes(self._full, self._width, self._dtype) <= limit
        self._maps = Maps(device, self._height, self._width)
        self._shared: dict[tuple[str, int], Padded] = {}
        self._changed: ChangedOnly | None = None
        self.inputs = inputs_for(device, self._height, self._width, self._dtype, self.keep)
        self._packing = PackInputs(device, self.inputs, height, width)
        self.features: dict[str, Padded] = {}
        if residual:
            self._encoder()
            self._history()
            self._erm()
            self._decoder()
        else:
            self._image(self.inputs.input)

    def pack(self, color: cl.Buffer, gbuffer: cl.Buffer, mask: cl.Buffer, history: cl.Buffer) -> None:
        """Bring the four inputs, plain arrays on the device, to where the first layers read them."""
        self._packing(color, gbuffer, mask, history, self._top)

    def all_finite(self) -> bool:
        """Whether all inputs packed since the last question were; waits for the queue."""
        return self._packing.all_finite()

    def place(self, strip: Strip) -> None:
        """Make the launches compute this strip."""
        self._top = strip.top
        for kernel, argument, divisor in self._placed:
            kernel.set_arg(argument, np.int32(strip.top // divisor))
        last = self.launches[-1]
        first, top = ROW_ARGUMENTS[last.kernel.function_name]
        last.kernel.set_arg(first, np.int32(strip.first))
        last.kernel.set_arg(top, np.int32(strip.top))
        if last.kernel.function_name == "winograd":
            last.kernel.set_arg(HEIGHT_ARGUMENT, np.int32(strip.last))
        else:
            self.launches[-1] = replace(last, size=(last.size[0], strip.last - strip.first))

    def ready(self, image: cl.Buffer) -> list[Launch]:
        """The launches in order, the last of them to write ``image`` (2H, 2W, 3) float32."""
        last = self.launches[-1]
        last.kernel.set_arg(IMAGE_ARGUMENT[last.kernel.function_name], image)
        return self.launches

    def run(self, image: cl.Buffer) -> None:
        """Enqueue the whole network; ``image`` is complete when the queue has run dry."""
        for launch in self.ready(image):
            launch.enqueue(self._device.queue)
        self._device.queue.flush()

    def run_changed(self, image: cl.Buffer, tolerance: float = 0.0) -> None:
        """Enqueue what the marks in the change maps of ``inputs`` lead to; the rest of ``image``, the last one made, stays.

        Whoever fills ``inputs`` marks the tiles that came to differ since the last run of either kind, and clears the marks after it.

        Args:
            image: as for ``run``.
            tolerance: a stored value between two layers that is no further than this from the new one stays; 0: the image has the bits
                of ``run``'s, if all runs since the last of those were so.
        """
        if self._changed is None:
            self._changed = ChangedOnly(self._device, self.launches, self._maps)
        self._changed.run(image, tolerance)

    def run_stage(self, stage: str, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """Run one stage alone, on arrays; H, W are multiples of 8 and the frame is one strip."""
        height, width = self.size
        self.place(self.strips[0])
        color = inputs.get("color", np.zeros((height, width, 6), np.float32))
        gbuffer = inputs.get("gbuffer", np.zeros((height, width, 9), np.float32))
        mask = inputs.get("mask", np.zeros((height, width), np.float32))
        history = inputs.get("history", np.zeros((3, height, width, 4), np.float32))
        held = [incoming(self._device, array) for array in (color, gbuffer, mask, history)]
        self.pack(*held)
        for name in ("x1", "x2", "x3", "x4"):
            if name in inputs:
                write(self._device, self.features[name], inputs[name])
        if stage == "decoder":
            both = np.concatenate([inputs["reshaded"], inputs["feature"]], axis=-1)
            write(self._device, self.features["reshaded"], both)
        image = Outgoing(self._device, (2 * height, 2 * width, 3), on_device=False)
        for launch in self.ready(image.data):
            if launch.stage == stage:
                launch.enqueue(self._device.queue)
        outputs = {
            "encoder": {"x1": ("x1", 0, 24), "x2": ("x2", 0, 24), "x3": ("x3", 0, 32), "x4": ("x4", 0, 32)},
            "history": {"feature": ("reshaded", 64, 32)},
            "erm": {"reshaded": ("reshaded", 0, 64)},
        }
        if stage == "decoder":
            return {"image": image.finish()}
        image.finish()
        return {name: read(self._device, self.features[key], first, n) for name, (key, first, n) in outputs[stage].items()}

    def _padded(self, divisor: int, channels: int) -> Padded:
        height, width = self._height // divisor, self._width // divisor
        made = padded(self._device, height, width, channels, self._dtype)
        return replace(made, changes=self._maps.take(height, width)) if self.keep else made

    def _scratch(self, name: str, divisor: int, channels: int) -> Padded:
        """Activations that are soon done with: those that were last asked for by this name, but that each is kept if all are."""
        if self.keep or (name, divisor) not in self._shared:
            self._shared[name, divisor] = self._padded(divisor, channels)
        return self._shared[name, divisor]

    def _conv(
        self,
        stage: str,
        name: str,
        a: Padded,
        out: Padded,
        *,
        b: Padded | None = None,
        channels: tuple[int, ...] | None = None,
        stride: int = 1,
        relu: bool = True,
        out_first: int = 0,
        image: int = 0,
        final: Final | None = None,
    ) -> Padded:
        """Append a convolution; ``channels``: how many of each input's are real, where not all."""
        held = (a,) if b is None else (a, b)
        real = channels or tuple(x.channels for x in held)
        packed = pack(self._weights, name, tuple((n, x.channels) for n, x in zip(real, held, strict=True)))
        launch = conv(
            self._device, stage, name, packed, a, b, out,
            out_first=out_first, stride=stride, relu=relu, winograd=self._winograd, image=image, final=final,
        )  # fmt: skip
        self.launches.append(launch)
        return out

    def _kernel(
        self,
        stage: str,
        name: str,
        file: str,
        options: dict[str, object],
        size: tuple[int, ...],
        *arguments: Any,
        group: tuple[int, ...] | None = None,
        maps: tuple[cl.Buffer | None, ...] = (),
        changed_size: tuple[int, ...] | None = None,
        bounded: bool = True,
    ) -> None:
        """Append any other kernel; whole numbers among the arguments are int32. ``maps``, ``changed_size``: for -D SKIP."""
        # Interpolation is not contracted: it then has the reference's bits.
        flags = FAST_MULTIPLY_ADD if file == "erm.cl" else ""
        options = {**options, "HALF": half(self._dtype)}
        kernel = cl.Kernel(build(self._device, file, options, flags), name)
        held = tuple(np.int32(a) if isinstance(a, int) else a for a in arguments)
        kernel.set_args(*held)
        skip = Skip(file, options, flags, changed_size or size, maps, bounded) if self.keep else None
        self.launches.append(Launch(stage, name, kernel, size, group, held, skip))

    def _encoder(self) -> None:
        x = self._conv("encoder", "conv1", self.inputs.input, self._scratch("full", 1, 24), channels=(21,))
        x = self.features["x1"] = self._conv("encoder", "conv2", x, self._padded(1, 24))
        for i, (channels, divisor) in enumerate(((24, 2), (32, 4), (32, 8)), start=1):
            name = f"down{i}"
            x = self._conv("encoder", f"{name}.downsample", x, self._padded(divisor, x.channels), stride=2, relu=False)
            x = self._conv("encoder", f"{name}.conv1", x, self._padded(divisor, channels))
            x = self._conv("encoder", f"{name}.conv2", x, self._padded(divisor, channels))
            self.features[f"x{i + 1}"] = x

    def _history(self) -> None:
        joined = self._padded(8, 96)
        self.features["reshaded"] = self._padded(8, 96)
        for image in range(3):
            x = self.inputs.earlier
            for name, channels, divisor in (("convHis1", 24, 2), ("convHis2", 32, 4), ("convHis3", 32, 8)):
                one = self._scratch("history", divisor, channels)
                x = self._conv("history", f"{name}.0", x, one, stride=2, image=image if divisor == 2 else 0)
                x = self._conv("history", f"{name}.2", x, self._scratch("history.2", divisor, channels))
                last = divisor == 8
                out = joined if last else self._scratch("history", divisor, channels)
                x = self._conv("history", f"{name}.4", x, out, out_first=32 * image if last else 0)
        self._conv("history", "lowlevelGated", joined, self.features["reshaded"], relu=False, out_first=64)

    def _erm(self) -> None:
        tile = 4 if self._device.is_cpu else 1
        options: dict[str, object] = {"KEYS": 32, "VALUES": 64, "MASK": "float", "SPAN": tile}
        out, size = self.features["reshaded"], (self._width // 8, self._height // 8)
        eighth = self.inputs.eighth
        light = self._conv(
            "erm", "latentEncoder.0", self.features["x4"], self._scratch("value", 8, 64), b=eighth, channels=(32, GBUFFER)
        )
        light = self._conv("erm", "latentEncoder.2", light, self._scratch("value.2", 8, 64))
        light = self._conv("erm", "latentEncoder.4", light, self._scratch("value", 8, 64), relu=False)
        key = self._conv("erm", "KEncoder.0", eighth, self._scratch("key", 8, 32), channels=(GBUFFER,))
        key = self._conv("erm", "KEncoder.2", key, self._scratch("key.2", 8, 32))
        key = self._conv("erm", "KEncoder.4", key, self._scratch("key", 8, 32), relu=False)
        unit = self._scratch("key.2", 8, 32)
        self._kernel(
            "erm", "normalise", "erm.cl", options, size, key.data, unit.data, key.columns, maps=(key.changes, unit.changes)
        )  # fmt: skip
        self._kernel(
            "erm", "attend", "erm.cl", options, size,
            unit.data, light.data, eighth.data, out.data, size[1], size[0], light.columns, out.channels,
            maps=(unit.changes, light.changes, eighth.changes, out.changes),
            changed_size=(ceil_div(size[0], tile), ceil_div(size[1], tile)),
        )  # fmt: skip

    def _decoder(self) -> None:
        x = self.features["reshaded"]
        for i, (middle, outputs, divisor) in enumerate(((64, 32, 4), (32, 24, 2), (24, 24, 1)), start=1):
            up = self._scratch("full" if divisor == 1 else "up", divisor, x.channels)
            tiles = span(self._device, 4) // 4
            options: dict[str, object] = {"CHANNELS": x.channels, "SPAN": tiles}
            self._kernel(
                "decoder", "upsample_corners", "resample.cl", options, (up.width, up.height),
                x.data, up.data, x.height, x.width, x.columns, up.columns, self._full // (2 * divisor), 0,
                maps=(x.changes, up.changes), changed_size=(ceil_div(ceil_div(up.width, 4), tiles), ceil_div(up.height, 4)),
            )  # fmt: skip
            self._placed.append((self.launches[-1].kernel, 7, 2 * divisor))
            skip = self.features[f"x{4 - i}"]
            name = f"up{i}.conv.double_conv"
            wide = self._padded(divisor, middle)
            x = self._conv("decoder", f"{name}.0", skip, wide, b=up)
            if i == 3:
                self._last(f"{name}.2", x)
                return
            x = self._conv("decoder", f"{name}.2", x, self._padded(divisor, outputs), channels=(28 if i == 2 else middle,))

    def _last(self, name: str, wide: Padded) -> None:
        """The last convolution and outc: in one launch where Winograd runs, else in two."""
        if self._winograd and tuning_for(self._device).winograd is not None:
            self._conv("decoder", name, wide, wide, final=self._final())
        else:
            self._image(self._conv("decoder", name, wide, self._padded(1, 24)))

    def _final(self) -> Final:
        weight, bias = (constant(self._device, array) for array in pack_outc(self._weights))
        return Final(self.inputs.base, weight, bias, self._height, self._width, *self.size, self.inputs.input.changes)

    def _image(self, feature: Padded) -> None:
        """outc, and the upsampled frame; where outc is 0 any finite feature will do."""
        final, width, strip = self._final(), self.size[1], tuning_for(self._device).strip
        columns = ceil_div(ceil_div(width, strip.pixels), strip.group) * strip.group
        self._kernel(
            "decoder", "image", "decoder.cl", {"STRIP": strip.pixels, "GROUP": strip.group}, (columns, self.size[0]),
            feature.data, final.color, final.weight, final.bias, final.bias, width, final.rows, final.columns, feature.columns, 0, 0,
            group=(strip.group, 1), maps=(feature.changes, final.changes), bounded=False,
        )  # fmt: skip
