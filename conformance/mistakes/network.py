# SPDX-License-Identifier: MIT
"""Mistakes in stages history, encoder, erm, decoder and network, and in the code that they share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np

from conformance.mistakes.precision import of_bits
from conformance.protocol.reference_copy import Mistake, Plant, change_arguments, fault, half, put, returns, wrap
from stss_ref.conv import conv_named, gated, relu, sigmoid
from stss_ref.erm import WINDOW, attend, divide, window
from stss_ref.resample import lerp_along, upsample_centres, upsample_corners

Change = Callable[..., Any]
OTHERS = ("history", "erm", "decoder")
"""Stages with convolutions, other than encoder."""


def _relu_missing(module: str, after: int) -> Plant:
    """No ReLU after one layer of the chains of a stage."""

    def wrong(x: Any, weights: Any, name: str, layers: Sequence[int]) -> Any:
        for i, stride in enumerate(layers):
            x = conv_named(x, weights, f"{name}.{2 * i}", stride)
            x = x if i == after else relu(x)
        return x

    return put(f"{module}.conv_chain", wrong)


def _gate_missing(module: str, of: str) -> Plant:
    """Layers named ``of`` are not gated."""

    def wrong(right: Change, x: Any, weights: Any, name: str, stride: int = 1) -> Any:
        return conv_named(x, weights, f"{name}.conv_feature", stride) if name.endswith(of) else right(x, weights, name, stride)

    return wrap(f"{module}.gated", wrong)


def _rolled(by: int, layer: str = "") -> Change:
    """The last ``by`` channels come first, in one layer or in all."""
    return lambda x, name="": np.roll(x, by, axis=-1) if not layer or name == layer else x


def _history(name: str, what: str, change: Change) -> Mistake:
    return fault("history", name, what, change_arguments("history.history_embedding", history=change))


def _with_mask(change: Callable[[Any, Any], tuple[Any, Any]]) -> Change:
    return lambda history: np.concatenate(change(history[..., :3], history[..., 3:]), axis=-1)


HISTORY = (
    _history("newest_first", "history newest first", lambda history: history[::-1]),
    _history("middle_first", "middle before oldest", lambda history: history[[1, 0, 2]]),
    _history("newest_only", "the newest frame three times", lambda history: history[[2, 2, 2]]),
    _history("mask_applied", "colours times the mask", _with_mask(lambda color, mask: (color * mask, mask))),
    _history("mask_inverted", "1 - mask", _with_mask(lambda color, mask: (color, 1 - mask))),
    _history("mask_first", "mask before the colour", _with_mask(lambda color, mask: (mask, color))),
    _history("of_8_bits", "history in 8 bits", lambda history: np.round(np.clip(history, 0, 1) * 255) / history.dtype.type(255)),
    _history("bgr", "colours in reverse", _with_mask(lambda color, mask: (color[..., ::-1], mask))),
    fault("history", "last_relu", "ReLU after lowlevelGated", returns("history.gated", lambda y: np.maximum(y, 0))),
    fault(
        "history",
        "gate_of_16_bits",
        "exp of 16 bits",
        put("conv.sigmoid", lambda x: 1 / (1 + of_bits(16)(np.exp(-x)))),
        bits=True,
    ),
    fault("history", "gate_missing", "no gate in lowlevelGated", _gate_missing("history", "lowlevelGated")),
    fault("history", "first_relu_missing", "no ReLU after the convolution of stride 2", _relu_missing("history", 0)),
    fault("history", "third_relu_missing", "no ReLU after the third convolution", _relu_missing("history", 2)),
)


_encoder = partial(fault, "encoder")
_gate = partial(fault, "encoder", also=("history",))


def _gbuffer(name: str, what: str, *channels: int) -> Mistake:
    return _encoder(name, what, change_arguments("encoder.encoder", gbuffer=lambda gbuffer: gbuffer[..., list(channels)]))


def _masked(name: str, what: str, change: Callable[[Any, Any], Iterable[Any]]) -> Mistake:
    """Colour and colour times mask are ``change(color, mask)``."""
    return _encoder(
        name, what, put("rrm.concat_masked", lambda color, mask: np.concatenate([*change(color, mask[..., None])], axis=-1))
    )


def _linear(name: str, what: str, of: str) -> Mistake:
    """Layers named ``of`` without ReLU."""

    def wrong(right: Change, x: Any, weights: Any, name: str) -> Any:
        return gated(x, weights, name) if name == of or name.endswith(f".{of}") else right(x, weights, name)

    return _encoder(name, what, wrap("encoder.gated_relu", wrong))


def _conv(name: str, what: str, *, also: tuple[str, ...] = OTHERS, **changes: Change) -> Mistake:
    """Every convolution is given others."""
    return _encoder(name, what, change_arguments("conv.conv", **changes), also=also)


def _edged(x: Any, r: int) -> Any:
    return np.pad(x, ((r, r), (r, r), (0, 0)), mode="edge")


def _row_above(x: Any, r: int) -> Any:
    return np.pad(x, ((2 * r, 0), (r, r), (0, 0)))


def _gate_unbiased(weights: Any, name: str) -> Any:
    bias = f"{name}.conv_mask.0.bias"
    return {**weights, bias: weights[bias] * 0}


def _gate_of_relu(_: Change, x: Any, weights: Any, name: str, stride: int = 1) -> Any:
    gate = conv_named(relu(x), weights, f"{name}.conv_mask.0", stride)
    return conv_named(x, weights, f"{name}.conv_feature", stride) * sigmoid(gate)


def _inputs_first(weight: Any) -> Any:
    """The numbers of (O, I, k, k) read as (I, O, k, k)."""
    return weight.reshape(weight.shape[1], weight.shape[0], *weight.shape[2:]).swapaxes(0, 1)


def _below_and_right(conv: Change, x: Any, weight: Any, bias: Any, stride: int = 1) -> Any:
    return conv(x, weight, bias)[stride - 1 :: stride, stride - 1 :: stride]


def _half_sum(conv: Change, x: Any, weight: Any, bias: Any, stride: int = 1) -> Any:
    """Rounded after the products of each tap."""
    (height, width, _), size = x.shape, weight.shape[-1]
    y, padded = bias, np.pad(x, ((size // 2, size // 2), (size // 2, size // 2), (0, 0)))
    for u, v in np.ndindex(size, size):
        y = half(y + conv(padded[u : u + height, v : v + width], weight[:, :, u : u + 1, v : v + 1], bias * 0, stride))
    return y


def _tiles(axis: int, side: int) -> Plant:
    """Each tile of rows (axis 0) or columns does not see the one before."""

    def wrong(conv: Change, x: Any, weight: Any, bias: Any, stride: int = 1) -> Any:
        y, unseen = conv(x, weight, bias, stride), weight.copy()
        if weight.shape[-1] > 1:
            unseen.swapaxes(2, 2 + axis)[:, :, 0] = 0
            y.swapaxes(0, axis)[side::side] = conv(x, unseen, bias, stride).swapaxes(0, axis)[side::side]
        return y

    return wrap("conv.conv", wrong)


ENCODER = (
    _encoder("gbuffer_first", "G-buffer before the colour", change_arguments("encoder.gated", x=_rolled(9, "conv1"))),
    _gbuffer("depth_first", "depth before the normal", 3, 0, 1, 2, 4, 5, 6, 7, 8),
    _gbuffer("metallic_first", "metallic before roughness", 0, 1, 2, 3, 5, 4, 6, 7, 8),
    _gbuffer("base_color_bgr", "base colour in reverse", 0, 1, 2, 3, 4, 5, 8, 7, 6),
    _encoder(
        "last_channel_lost",
        "channel 21 lost in vectors of 4",
        change_arguments("encoder.encoder", gbuffer=lambda g: g * (np.arange(9) < 8)),
    ),
    _encoder("warped_first", "warped before occlusion_warp", change_arguments("encoder.encoder", color=_rolled(3))),
    _masked("masked_first", "color mask before color", lambda color, mask: (color * mask, color)),
    _masked("mask_inverted", "color (1 - mask)", lambda color, mask: (color, color * (1 - mask))),
    _masked("mask_ignored", "color twice", lambda color, mask: (color, color)),
    _masked(
        "mask_on_three", "mask times the first colour only", lambda color, mask: (color, color[..., :3] * mask, color[..., 3:])
    ),
    _masked("masked_twice", "color masked in both places", lambda color, mask: (color * mask, color * mask)),
    _linear("conv1_relu_missing", "no ReLU after conv1", "conv1"),
    _linear("conv2_relu_missing", "no ReLU after conv2", "conv2"),
    _encoder(
        "relu_after_stride",
        "ReLU after the gate of stride 2",
        returns("encoder.gated", lambda y, stride: np.maximum(y, 0) if stride == 2 else y),
    ),
    _encoder("strided_gate_missing", "no gate at stride 2", _gate_missing("encoder", "downsample")),
    _encoder("down_gate_missing", "no gate in the last layer of down", _gate_missing("encoder", ".conv2")),
    _gate("gate_linear", "no sigmoid", put("conv.sigmoid", lambda x: x)),
    _gate("hard_sigmoid", "min(max(x / 6 + 1/2, 0), 1)", put("conv.sigmoid", lambda x: np.clip(x / 6 + 0.5, 0, 1))),
    _gate("half_gate", "gates in half precision", returns("conv.sigmoid", half)),
    _gate("half_sigmoid", "exp in half precision", put("conv.sigmoid", lambda x: 1 / (1 + half(np.exp(-x))))),
    _gate("gate_inverted", "1 - sigmoid", change_arguments("conv.sigmoid", x=np.negative)),
    _gate(
        "sigmoid_saturates",
        "sigmoid from a table that ends at 4",
        change_arguments("conv.sigmoid", x=lambda x: np.clip(x, -4, 4)),
    ),
    _gate("gate_unbiased", "the gate's bias forgotten", change_arguments("conv.gated", weights=_gate_unbiased)),
    _gate("sigmoid_by_powers", "exp(x) as (1 + x / 256)^256", put("conv.sigmoid", lambda x: 1 / (1 + (1 - x / 256) ** 256))),
    _encoder("gate_of_relu", "the gate reads the input behind a ReLU", wrap("conv.gated", _gate_of_relu)),
    _encoder("relu6", "ReLU that ends at 6", returns("conv.relu", lambda y: np.minimum(y, 6)), also=OTHERS),
    _encoder("leaky_relu", "a leaky ReLU", returns("conv.relu", lambda _, x: np.maximum(x, x * 0.01)), also=OTHERS),
    _encoder("replicated", "replicates the border instead of zeros", put("conv.surround_with_zeros", _edged), also=OTHERS),
    _encoder("row_above", "the window one row up", put("conv.surround_with_zeros", _row_above), also=OTHERS),
    _encoder("strided_side", "stride 2 pads below and right only", wrap("conv.conv", _below_and_right), also=("history",)),
    _conv("transposed", "rows and columns of the kernel swapped", weight=lambda weight: weight.swapaxes(2, 3)),
    _conv("flipped", "convolution for cross-correlation", weight=lambda weight: weight[:, :, ::-1, ::-1]),
    _conv(
        "outputs_first",
        "outputs for inputs where there are as many",
        weight=lambda w: w.swapaxes(0, 1) if w.shape[0] == w.shape[1] else w,
        also=("history", "erm"),
    ),
    _conv("inputs_first", "weights read as (input, output, row, column)", weight=_inputs_first),
    _conv("unbiased", "no bias", bias=np.zeros_like),
    _conv("biased_twice", "the bias twice", bias=lambda bias: bias * 2),
    _conv("half_weights", "weights in half precision", weight=half),
    _conv("tf32", "factors of 10 bits", x=half, weight=half),
    _encoder("half_sum", "sums in half precision", wrap("conv.conv", _half_sum), also=OTHERS),
    _encoder("tile_without_halo", "tiles of 16 rows do not see the row above", _tiles(0, 16), also=("history", "decoder")),
    _encoder(
        "tile_64", "tiles of 64 columns do not see the column before", _tiles(1, 64), also=("history", "decoder"), large=True
    ),
)


_erm = partial(fault, "erm")


def _last_relu(name: str, of: str) -> Mistake:
    return _erm(
        name, f"ReLU after the last layer of {of}", change_arguments("erm.conv_chain", last_relu=lambda _, name: name == of)
    )


def _within_last(right: Change, x: Any) -> Iterable[Any]:
    all_but_the_last = np.zeros_like(x)
    all_but_the_last[:-1, :-1] = x[:-1, :-1]
    return right(all_but_the_last)


def _summed_before_relu(query: Any, key: Any, value: Any) -> Any:
    total, weight_sum = np.zeros_like(value), np.zeros_like(value[..., :1])
    for key_there, value_there in zip(window(key), window(value), strict=True):
        weight = (key_there * query).sum(axis=-1, keepdims=True)
        total += relu(weight) * value_there
        weight_sum += weight
    return divide(total, weight_sum)


def _every_64th(window: Change, x: Any) -> Iterable[Any]:
    columns = np.arange(x.shape[1]) % 64
    return (there * (columns >= WINDOW // 2 - i % WINDOW)[:, None] for i, there in enumerate(window(x)))


def _masks(name: str, what: str, change: Callable[[Any, Any, Any], tuple[Any, Any, Any]]) -> Mistake:
    """Query, key and value are ``change`` of material, light and mask."""
    return _erm(name, what, put("erm.reshade", lambda light, material, m: attend(*change(material, light, m))))


def _weight(name: str, what: str, change: Callable[[Any], Any]) -> Mistake:
    """A weight is ``change`` of key times query."""
    return _erm(name, what, put("erm.likeness", lambda key, query: change((key * query).sum(axis=-1, keepdims=True))))


def _length(name: str, what: str, change: Callable[[Any], Any]) -> Mistake:
    """A vector is divided by ``change`` of its square to normalise it."""
    return _erm(name, what, put("erm.normalise", lambda x: x / change((x * x).sum(axis=-1, keepdims=True))))


def _down(name: str, what: str, rows: Callable[[Any], Any]) -> Mistake:
    """To 1/8 size by ``rows``, and the same of columns."""
    return _erm(name, what, put("resample.downsample_8", lambda x: rows(rows(x).swapaxes(0, 1)).swapaxes(0, 1)))


def _tent(x: Any) -> Any:
    """(n, ...) to (n / 8, ...): means weighted by a triangle, 8 pixels to each side of the centre."""
    weights = np.maximum(0, 1 - np.abs(np.arange(len(x)) - (8 * np.arange(len(x) // 8)[:, None] + 3.5)) / 8)
    return np.tensordot((weights / weights.sum(axis=1, keepdims=True)).astype(x.dtype), x, 1)


ERM = (
    _erm("window_3", "3 x 3", put("erm.WINDOW", 3)),
    _erm("window_7", "7 x 7", put("erm.WINDOW", 7)),
    _erm(
        "window_shifted",
        "the window one row up",
        wrap("erm.window", lambda right, x: right(np.pad(x, ((1, 0), (0, 0), (0, 0)))[:-1])),
    ),
    _erm("window_clamped", "replicates the border instead of zeros", put("erm.surround_with_zeros", _edged)),
    _erm(
        "own_pixel_left_out",
        "the window's own pixel takes no part",
        returns("erm.window", lambda places: (there * (i != WINDOW**2 // 2) for i, there in enumerate(places))),
    ),
    _erm(
        "value_mirrored",
        "V(p - d) for V(p + d)",
        returns("erm.window", lambda places, x: [*places][:: -1 if x.shape[-1] == 64 else 1]),
    ),
    _erm("last_left_out", "windows do not see the frame's last row and column", wrap("erm.window", _within_last)),
    _erm(
        "window_64",
        "windows do not see across every 64th column",
        wrap("erm.window", _every_64th),
        large=True,
    ),
    _masks("key_unmasked", "the key is not masked", lambda k, v, m: (k, k, v * m)),
    _masks("key_mask_inverted", "the key times 1 - m", lambda k, v, m: (k, k * (1 - m), v * m)),
    _masks("query_masked", "masks the query instead of the key", lambda k, v, m: (k * m, k, v * m)),
    _masks("query_masked_too", "masks query and key", lambda k, v, m: (k * m, k * m, v * m)),
    _masks("value_unmasked", "the value is not masked", lambda k, v, m: (k, k * m, v)),
    _masks("value_mask_inverted", "the value times 1 - m", lambda k, v, m: (k, k * m, v * (1 - m))),
    _masks("value_masked_twice", "the value times m m", lambda k, v, m: (k, k * m, v * m * m)),
    _masks("mask_yes_or_no", "a mask of 1/4 is 1", lambda k, v, m: (k, k * (m > 0), v * (m > 0))),
    _masks("mask_threshold", "a mask below 1 is 0", lambda k, v, m: (k, k * (m == 1), v * (m == 1))),
    _erm("gbuffer_first", "f before x4", change_arguments("erm.conv_chain", x=_rolled(9, "latentEncoder"))),
    _last_relu("light_relu", "latentEncoder"),
    _last_relu("material_relu", "KEncoder"),
    _length("not_normalised", "K is not normalised", np.ones_like),
    _length("not_rooted", "divides by the length's square", lambda square: np.maximum(square, 1e-12)),
    _length("epsilon_added", "adds 1e-3 to the length", lambda square: np.sqrt(square) + 1e-3),
    _length("epsilon_inside", "adds 1e-5 under the root", lambda square: np.sqrt(square + 1e-5)),
    _length(
        "square_in_half",
        "the square of a length ends at 65504",
        lambda square: np.maximum(np.sqrt(np.minimum(square, 65504)), 1e-12),
    ),
    _weight("weight_relu_missing", "weights may be negative", lambda weight: weight),
    _weight("weight_absolute", "|w| for relu(w)", np.abs),
    _weight("softmax", "exp for ReLU", np.exp),
    _weight("half_weight", "weights in half precision", lambda weight: half(np.maximum(weight, 0))),
    _erm("summed_before_relu", "the sum of weights has negative ones", put("erm.attend", _summed_before_relu)),
    _erm("undivided", "as in the paper: not divided by the sum", put("erm.divide", lambda total, _: total)),
    _erm("mean", "divides by the number of pixels", put("erm.divide", lambda total, _: total / WINDOW**2)),
    _erm("unclamped_sum", "0 / 0 where nothing is to be trusted", put("erm.divide", np.divide)),
    _erm("sum_epsilon", "adds 1e-3 to the sum", put("erm.divide", lambda total, weights: total / (weights + 1e-3))),
    _down("down_4_and_5", "pixels 8i + 4 and 8i + 5", lambda x: (x[4::8] + x[5::8]) / 2),
    _down("down_first", "pixel 8i", lambda x: x[::8]),
    _down("down_nearest", "pixel 8i + 4", lambda x: x[4::8]),
    _erm(
        "mask_of_a_pixel",
        "the mask at 1/8 size is that of pixel 8i + 3",
        wrap("erm.downsample_8", lambda right, x: x[3::8, 3::8] if x.shape[-1] == 1 else right(x)),
    ),
    _down("down_mean", "the mean of the 8 x 8 block", lambda x: x.reshape(len(x) // 8, 8, *x.shape[1:]).mean(axis=1)),
    _down("down_antialias", "a tent of 16 pixels, as resizing with antialiasing has it", _tent),
)


_decoder = partial(fault, "decoder")


def _shuffle(name: str, what: str, order: Callable[[Any], Any]) -> Mistake:
    """The pixel shuffle takes its channels for others: ``order`` of their numbers (colour, row, column)."""
    channels = order(np.arange(12)).ravel()
    return _decoder(name, what, change_arguments("resample.pixel_shuffle", x=lambda x: x[..., channels]))


def _resampled(name: str, what: str, grid: str, at: Callable[[int], Any]) -> Mistake:
    """Twice the size, from the positions ``at(n)`` of ``n`` pixels."""

    def wrong(x: Any) -> Any:
        for axis in (0, 1):
            x = lerp_along(x, at(x.shape[axis]), axis)
        return x

    return _decoder(name, what, put(f"resample.upsample_{grid}", wrong))


def _repeated(x: Any) -> Any:
    return x.repeat(2, axis=0).repeat(2, axis=1)


DECODER = (
    _shuffle("shuffle_transposed", "rows and columns of the pixel shuffle swapped", lambda i: i.reshape(3, 2, 2).swapaxes(1, 2)),
    _shuffle("shuffle_color_fastest", "depth to space with the colour fastest", lambda i: i.reshape(2, 2, 3).transpose(2, 0, 1)),
    _shuffle("shuffle_upside_down", "rows of the pixel shuffle from below", lambda i: i.reshape(3, 2, 2)[:, ::-1]),
    _resampled("corners_as_halves", "corners aligned: o / 2", "corners", lambda n: np.arange(2 * n) / 2),
    _resampled("corners_over_n", "corners aligned: o (n - 1) / N", "corners", lambda n: np.arange(2 * n) * ((n - 1) / (2 * n))),
    _resampled("centres_as_halves", "centres aligned: o / 2", "centres", lambda n: np.arange(2 * n) / 2),
    _resampled(
        "centres_unclamped",
        "centres aligned: the last pixel before the first",
        "centres",
        lambda n: np.arange(2 * n) / 2 - 0.25,
    ),
    _decoder(
        "texture_fraction",
        "a texture sampler, whose fraction has 8 bits",
        change_arguments("resample.lerp_along", at=lambda at: np.floor(at * 256) / 256),
    ),
    _decoder("features_by_centres", "features upsampled with centres aligned", put("decoder.upsample_corners", upsample_centres)),
    _decoder("features_nearest", "features upsampled by repeating pixels", put("decoder.upsample_corners", _repeated)),
    _decoder("base_by_corners", "colour upsampled with corners aligned", put("decoder.upsample_centres", upsample_corners)),
    _decoder("base_nearest", "colour upsampled by repeating pixels", put("decoder.upsample_centres", _repeated)),
    _decoder("base_missing", "the residual alone", change_arguments("decoder.decoder", color=np.zeros_like)),
    _decoder("base_of_warped", "adds warped, not occlusion_warp", change_arguments("decoder.decoder", color=_rolled(3))),
    _decoder(
        "base_bgr", "adds the colours in reverse", change_arguments("decoder.decoder", color=lambda c: c[..., [2, 1, 0, 3, 4, 5]])
    ),
    _decoder("residual_subtracted", "the residual with the other sign", returns("decoder.pixel_shuffle", np.negative)),
    _decoder("outc_relu", "ReLU after outc", returns("decoder.pixel_shuffle", lambda image: np.maximum(image, 0))),
    _decoder("clipped", "clips the image to [0, 1]", returns("decoder.decoder", lambda image: np.clip(image, 0, 1))),
    _decoder(
        "history_first",
        "feature before reshaded",
        change_arguments("decoder.upsample_corners", x=lambda x: np.roll(x, 32, axis=-1) if x.shape[-1] == 96 else x),
    ),
    _decoder(
        "skip_last",
        "the skip after the upsampled features",
        change_arguments("decoder.conv_chain", x=lambda x, name: np.roll(x, -32 if name.startswith("up1") else -24, axis=-1)),
    ),
    _decoder(
        "outputs_by_8",
        "outputs behind the last multiple of 8 are 0",
        returns("conv.conv", lambda y: y * (np.arange(y.shape[-1]) < y.shape[-1] // 8 * 8)),
    ),
    _decoder("first_relu_missing", "no ReLU between the two convolutions", _relu_missing("decoder", 0)),
    _decoder("second_relu_missing", "no ReLU after the two convolutions", _relu_missing("decoder", 1)),
)


_network = partial(fault, "network")


def _pad(x: Any, sides: Callable[[int], tuple[int, int]] = lambda n: (0, -n % 8), **how: Any) -> Any:
    """With ``sides(height)`` more rows, and as many columns for the width."""
    height, width = x.shape[-3:-1]
    return np.pad(x, [(0, 0)] * (x.ndim - 3) + [sides(height), sides(width), (0, 0)], **how)


def _to_8(name: str, what: str, *sides: Callable[[int], tuple[int, int]], **how: Any) -> Mistake:
    return _network(name, what, put("resample.pad_to_8", lambda x: _pad(x, *sides, **how)))


NETWORK = (
    _to_8("padded_with_zeros", "pads to multiples of 8 with zeros"),
    _to_8("padded_by_mirror", "pads with the mirror image", mode="symmetric"),
    _to_8("padded_above", "pads above and left, crops below and right", lambda n: (-n % 8, 0), mode="edge"),
    _to_8("padded_always", "pads by 8 where nothing is missing", lambda n: (0, 8 - n % 8), mode="edge"),
    _to_8("padded_to_16", "pads to multiples of 16", lambda n: (0, -n % 16), mode="edge"),
    _network(
        "mask_padded_with_zeros",
        "what is padded is a hole",
        wrap("network.pad_to_8", lambda right, x: right(x) if x.shape[-1] > 1 else _pad(x)),
    ),
    _network(
        "history_padded_with_zeros",
        "pads the history with zeros",
        wrap("network.pad_to_8", lambda right, x: right(x) if x.ndim == 3 else _pad(x)),
    ),
    _network("erm_unmasked", "no mask in the ERM", change_arguments("network.erm", mask=np.ones_like)),
)
