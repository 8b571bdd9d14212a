# SPDX-License-Identifier: MIT
"""The network's buffers and launches for one frame size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl

from stss_cl.buffers import FLAGS, Outgoing, Padded, constant, incoming, inputs_for, padded, read, write
from stss_cl.device import Device
from stss_cl.launch import FAST_MULTIPLY_ADD, HEIGHT_ARGUMENT, IMAGE_ARGUMENT, ROW_ARGUMENTS, Final, Launch, conv, half
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

        self.inputs = inputs_for(device, self._height, self._width, self._dtype)
        self.bad = cl.Buffer(device.context, FLAGS.READ_WRITE | FLAGS.COPY_HOST_PTR, hostbuf=np.zeros(2, np.int32))
        self.features: dict[str, Padded] = {}
        self._packing()
        if residual:
            self._encoder()
            self._history()
            self._erm()
            self._decoder()
        else:
            self._image(self.inputs.input)

    def pack(self, color: cl.Buffer, gbuffer: cl.Buffer, mask: cl.Buffer, history: cl.Buffer) -> None:
        """Bring the four inputs, plain arrays on the device, to where the first layers read them."""
        queue = self._device.queue
        full, eighth = (self._width, self._height), (self._width // 8, self._height // 8)
        size = [np.int32(n) for n in self.size]
        top = np.int32(self._top)
        columns = np.int32(self.inputs.input.columns)
        self._pack_input(
            queue, full, None, color, gbuffer, mask, self.inputs.input.data, self.inputs.base, self.bad, *size, columns, top
        )
        self._pack_eighth(
            queue, eighth, None, gbuffer, mask, self.inputs.eighth.data, *size, np.int32(self.inputs.eighth.columns), top
        )
        columns, rows = np.int32(self.inputs.earlier.columns), np.int32(self.inputs.earlier.rows)
        self._pack_history(queue, (*full, 3), None, history, self.inputs.earlier.data, self.bad, *size, rows, columns, top)

    def all_finite(self) -> bool:
        """Whether all inputs packed since the last question were; waits for the queue."""
        bad = np.empty(2, np.int32)
        cl.enqueue_copy(self._device.queue, bad, self.bad)
        if bad.any():
            cl.enqueue_fill_buffer(self._device.queue, self.bad, np.zeros(1, np.int32), 0, 8)
        return not bad.any()

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
        return padded(self._device, self._height // divisor, self._width // divisor, channels, self._dtype)

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
    ) -> None:
        """Append any other kernel; whole numbers among the arguments are int32."""
        # Interpolation is not contracted: it then has the reference's bits.
        flags = FAST_MULTIPLY_ADD if file == "erm.cl" else ""
        kernel = cl.Kernel(build(self._device, file, {**options, "HALF": half(self._dtype)}, flags), name)
        kernel.set_args(*(np.int32(a) if isinstance(a, int) else a for a in arguments))
        self.launches.append(Launch(stage, name, kernel, size, group, arguments))

    def _encoder(self) -> None:
        temporary = self._padded(1, 24)
        x = self._conv("encoder", "conv1", self.inputs.input, temporary, channels=(21,))
        x = self.features["x1"] = self._conv("encoder", "conv2", x, self._padded(1, 24))
        for i, (channels, divisor) in enumerate(((24, 2), (32, 4), (32, 8)), start=1):
            name = f"down{i}"
            x = self._conv("encoder", f"{name}.downsample", x, self._padded(divisor, x.channels), stride=2, relu=False)
            x = self._conv("encoder", f"{name}.conv1", x, self._padded(divisor, channels))
            x = self._conv("encoder", f"{name}.conv2", x, self._padded(divisor, channels))
            self.features[f"x{i + 1}"] = x
        self._temporary = temporary

    def _history(self) -> None:
        buffers = {
            divisor: [self._padded(divisor, channels) for _ in range(2)] for channels, divisor in ((24, 2), (32, 4), (32, 8))
        }
        joined = self._padded(8, 96)
        self.features["reshaded"] = self._padded(8, 96)
        for image in range(3):
            x = self.inputs.earlier
            for name, divisor in (("convHis1", 2), ("convHis2", 4), ("convHis3", 8)):
                one, other = buffers[divisor]
                x = self._conv("history", f"{name}.0", x, one, stride=2, image=image if divisor == 2 else 0)
                x = self._conv("history", f"{name}.2", x, other)
                last = divisor == 8
                x = self._conv("history", f"{name}.4", x, joined if last else one, out_first=32 * image if last else 0)
        self._conv("history", "lowlevelGated", joined, self.features["reshaded"], relu=False, out_first=64)

    def _erm(self) -> None:
        options: dict[str, object] = {"KEYS": 32, "VALUES": 64, "MASK": "float"}
        out, size = self.features["reshaded"], (self._width // 8, self._height // 8)
        keys, values = [self._padded(8, 32) for _ in range(2)], [self._padded(8, 64) for _ in range(2)]
        light = self._conv("erm", "latentEncoder.0", self.features["x4"], values[0], b=self.inputs.eighth, channels=(32, GBUFFER))
        light = self._conv("erm", "latentEncoder.2", light, values[1])
        light = self._conv("erm", "latentEncoder.4", light, values[0], relu=False)
        key = self._conv("erm", "KEncoder.0", self.inputs.eighth, keys[0], channels=(GBUFFER,))
        key = self._conv("erm", "KEncoder.2", key, keys[1])
        key = self._conv("erm", "KEncoder.4", key, keys[0], relu=False)
        self._kernel("erm", "normalise", "erm.cl", options, size, key.data, keys[1].data, key.columns)
        self._kernel(
            "erm", "attend", "erm.cl", options, size,
            keys[1].data, light.data, self.inputs.eighth.data, out.data, size[1], size[0], light.columns, out.channels,
        )  # fmt: skip

    def _decoder(self) -> None:
        x = self.features["reshaded"]
        for i, (middle, outputs, divisor) in enumerate(((64, 32, 4), (32, 24, 2), (24, 24, 1)), start=1):
            up = self._padded(divisor, x.channels) if divisor > 1 else self._temporary
            size = (2 * x.width, 2 * x.height)
            self._kernel(
                "decoder", "upsample_corners", "resample.cl", {"CHANNELS": x.channels}, size,
                x.data, up.data, x.height, x.width, x.columns, up.columns, self._full // (2 * divisor), 0,
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
        return Final(self.inputs.base, weight, bias, self._height, self._width, *self.size)

    def _image(self, feature: Padded) -> None:
        """outc, and the upsampled frame; where outc is 0 any finite feature will do."""
        final, width, strip = self._final(), self.size[1], tuning_for(self._device).strip
        columns = ceil_div(ceil_div(width, strip.pixels), strip.group) * strip.group
        self._kernel(
            "decoder", "image", "decoder.cl", {"STRIP": strip.pixels, "GROUP": strip.group}, (columns, self.size[0]),
            feature.data, final.color, final.weight, final.bias, final.bias, width, final.rows, final.columns, feature.columns, 0, 0,
            group=(strip.group, 1),
        )  # fmt: skip

    def _packing(self) -> None:
        options: dict[str, object] = {"HALF": half(self._dtype)}
        program = build(self._device, "encoder.cl", options)
        erm = build(self._device, "erm.cl", {"KEYS": 32, "VALUES": 64, "MASK": "float", **options}, FAST_MULTIPLY_ADD)
        self._pack_input, self._pack_history = cl.Kernel(program, "pack_input"), cl.Kernel(program, "pack_history")
        self._pack_eighth = cl.Kernel(erm, "downsample_8")
