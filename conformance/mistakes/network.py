# SPDX-License-Identifier: MIT
"""Mistakes in stages history and encoder, and in the code that they share with erm and decoder."""

from collections.abc import Sequence
from typing import Any

from conformance.mistakes.variants import Change, Mistake, fault

CONV = "conv.py"
OTHERS = ("history", "erm", "decoder")
"""Stages with convolutions, other than encoder."""

_PAD = "padded = np.pad(x, ((r, r), (r, r), (0, 0)))"
_BIAS = "y[...] = bias"
_SUM = "y += np.matmul(tap, np.ascontiguousarray(weight[:, :, u, v].T), out=product)"
_TAP_WEIGHT = "weight[:, :, u, v].T"
_SIGMOID = "return np.where(x >= 0, 1, small) / (1 + small)"
_SMALL = "small = np.exp(-np.abs(x))"
_GATED = 'return feature * sigmoid(conv_named(x, weights, f"{name}.conv_mask.0", stride))'
_RELU = "return np.maximum(x, 0)"
_NO_HALO = f"""if u == 0:
                tap = tap.copy()
                tap[16::16] = 0
            {_SUM}"""

_HISTORY = "history.py"
_EACH = "for x in history:"
_FUSE = 'return gated(np.concatenate(embedded, axis=-1), weights, "lowlevelGated")'
_CHAIN = "x = conv_chain(x, weights, name, (2, 1, 1))"


def _history(name: str, what: str, *change: str, more: Sequence[Change] = ()) -> Mistake:
    return fault("history", name, what, _HISTORY, *change, more=more)


def _reordered(channels: list[int]) -> str:
    return f"for x in history[..., {channels}]:"


HISTORY = (
    _history("newest_first", "newest first", _EACH, "for x in history[::-1]:"),
    _history("middle_first", "middle before oldest", _EACH, "for x in history[[1, 0, 2]]:"),
    _history("newest_only", "the newest frame three times", _EACH, "for x in history[[2, 2, 2]]:"),
    _history(
        "mask_applied",
        "colours times the mask",
        _EACH,
        "for x in np.concatenate([history[..., :3] * history[..., 3:], history[..., 3:]], axis=-1):",
    ),
    _history("mask_inverted", "1 - mask", _EACH, "for x in np.concatenate([history[..., :3], 1 - history[..., 3:]], axis=-1):"),
    _history("mask_first", "mask before the colour", _EACH, _reordered([3, 0, 1, 2])),
    _history("bgr", "colours in reverse", _EACH, _reordered([2, 1, 0, 3])),
    _history(
        "last_relu",
        "ReLU after lowlevelGated",
        _FUSE,
        'return np.maximum(gated(np.concatenate(embedded, axis=-1), weights, "lowlevelGated"), 0)',
    ),
    _history(
        "gate_missing",
        "no gate in lowlevelGated",
        _FUSE,
        'return conv_named(np.concatenate(embedded, axis=-1), weights, "lowlevelGated.conv_feature")',
        more=[(_HISTORY, "import conv_chain, gated", "import conv_chain, conv_named")],
    ),
    _history(
        "third_relu_missing",
        "no ReLU after the third convolution",
        _CHAIN,
        "x = conv_chain(x, weights, name, (2, 1, 1), last_relu=False)",
    ),
    fault(
        "history",
        "first_relu_missing",
        "no ReLU after the convolution of stride 2",
        CONV,
        "if last_relu or i < len(layers) - 1:",
        "if stride == 1 and (last_relu or i < len(layers) - 1):",
    ),
    fault(
        "history",
        "strided_side",
        "stride 2 pads below and right only",
        CONV,
        _PAD,
        "side = (r, r) if stride == 1 else (0, 2 * r)\n    padded = np.pad(x, (side, side, (0, 0)))",
        also=("encoder",),
    ),
    fault(
        "history", "leaky_relu", "a leaky ReLU", CONV, _RELU, "return np.maximum(x, x * 0.01)", also=("encoder", "erm", "decoder")
    ),
)

_ENCODER = "encoder.py"
_RRM = "rrm.py"
_INPUT = "x = np.concatenate([concat_masked(color, mask), gbuffer], axis=-1)"
_MASKED = "return np.concatenate([color, color * mask[..., None]], axis=-1)"
_FIRST = 'x1 = relu(gated(relu(gated(x, weights, "conv1")), weights, "conv2"))'
_STRIDED = 'x = gated(x, weights, f"{name}.downsample", stride=2)'
_DOWN = 'return relu(gated(relu(gated(x, weights, f"{name}.conv1")), weights, f"{name}.conv2"))'
_NAMED = (_ENCODER, "import gated, relu", "import conv_named, gated, relu")


def _encoder(name: str, what: str, *change: str, more: Sequence[Change] = ()) -> Mistake:
    return fault("encoder", name, what, _ENCODER, *change, more=more)


def _conv(name: str, what: str, *change: str, also: tuple[str, ...] = OTHERS, **marks: Any) -> Mistake:
    return fault("encoder", name, what, CONV, *change, also=also, **marks)


def _gbuffer(channels: list[int]) -> str:
    return _INPUT.replace("gbuffer", f"gbuffer[..., {channels}]")


ENCODER = (
    _encoder(
        "gbuffer_first",
        "G-buffer before the colour",
        _INPUT,
        "x = np.concatenate([gbuffer, concat_masked(color, mask)], axis=-1)",
    ),
    _encoder("depth_first", "depth before the normal", _INPUT, _gbuffer([3, 0, 1, 2, 4, 5, 6, 7, 8])),
    _encoder("metallic_first", "metallic before roughness", _INPUT, _gbuffer([0, 1, 2, 3, 5, 4, 6, 7, 8])),
    _encoder("base_color_bgr", "base colour in reverse", _INPUT, _gbuffer([0, 1, 2, 3, 4, 5, 8, 7, 6])),
    _encoder(
        "last_channel_lost",
        "channel 21 lost in vectors of 4",
        _INPUT,
        "x = np.concatenate([concat_masked(color, mask), gbuffer[..., :8], gbuffer[..., 8:] * 0], axis=-1)",
    ),
    _encoder(
        "warped_first", "warped before occlusion_warp", _INPUT, _INPUT.replace("(color,", "(color[..., [3, 4, 5, 0, 1, 2]],")
    ),
    fault(
        "encoder",
        "masked_first",
        "color mask before color",
        _RRM,
        _MASKED,
        "return np.concatenate([color * mask[..., None], color], axis=-1)",
    ),
    fault(
        "encoder",
        "mask_inverted",
        "color (1 - mask)",
        _RRM,
        _MASKED,
        _MASKED.replace("* mask[..., None]", "* (1 - mask[..., None])"),
    ),
    fault("encoder", "mask_ignored", "color twice", _RRM, _MASKED, "return np.concatenate([color, color], axis=-1)"),
    fault(
        "encoder",
        "mask_on_three",
        "mask times the first colour only",
        _RRM,
        _MASKED,
        "return np.concatenate([color, color[..., :3] * mask[..., None], color[..., 3:]], axis=-1)",
    ),
    fault(
        "encoder",
        "masked_twice",
        "color masked in both places",
        _RRM,
        _MASKED,
        _MASKED.replace("[color, ", "[color * mask[..., None], "),
    ),
    _encoder(
        "conv1_relu_missing", "no ReLU after conv1", _FIRST, 'x1 = relu(gated(gated(x, weights, "conv1"), weights, "conv2"))'
    ),
    _encoder(
        "conv2_relu_missing", "no ReLU after conv2", _FIRST, 'x1 = gated(relu(gated(x, weights, "conv1")), weights, "conv2")'
    ),
    _encoder(
        "relu_after_stride",
        "ReLU after the gate of stride 2",
        _STRIDED,
        'x = relu(gated(x, weights, f"{name}.downsample", stride=2))',
    ),
    _encoder(
        "down_relu_missing",
        "no ReLU after the last layer of down",
        _DOWN,
        'return gated(relu(gated(x, weights, f"{name}.conv1")), weights, f"{name}.conv2")',
    ),
    _encoder(
        "strided_gate_missing",
        "no gate at stride 2",
        _STRIDED,
        'x = conv_named(x, weights, f"{name}.downsample.conv_feature", stride=2)',
        more=[_NAMED],
    ),
    _encoder(
        "down_gate_missing",
        "no gate in the last layer of down",
        _DOWN,
        _DOWN.replace("relu(gated(relu", "relu(conv_named(relu").replace(".conv2", ".conv2.conv_feature"),
        more=[_NAMED],
    ),
    _conv("gate_inverted", "1 - sigmoid", _GATED, _GATED.replace("sigmoid(conv", "sigmoid(-conv"), also=("history",)),
    _conv(
        "gate_linear",
        "no sigmoid",
        _GATED,
        'return feature * conv_named(x, weights, f"{name}.conv_mask.0", stride)',
        also=("history",),
    ),
    _conv(
        "gate_unbiased",
        "the gate's bias forgotten",
        _GATED,
        'gate = f"{name}.conv_mask.0"\n'
        '    return feature * sigmoid(conv(x, weights[f"{gate}.weight"], weights[f"{gate}.bias"] * 0, stride))',
        also=("history",),
    ),
    _conv("hard_sigmoid", "min(max(x / 6 + 1/2, 0), 1)", _SIGMOID, "return np.clip(x / 6 + 0.5, 0, 1)", also=("history",)),
    _conv(
        "rational_sigmoid",
        "a rational tanh, good to 2e-2",
        _SIGMOID,
        "t = np.clip(x / 2, -3, 3)\n    return 0.5 + 0.5 * t * (27 + t * t) / (27 + 9 * t * t)",
        also=("history",),
    ),
    _conv(
        "half_sigmoid",
        "exp in half precision",
        _SMALL,
        "small = np.exp(-np.abs(x)).astype(np.float16).astype(x.dtype)",
        also=("history",),
    ),
    _conv(
        "sigmoid_saturates",
        "sigmoid from a table that ends at 4",
        _SMALL,
        "small = np.exp(-np.minimum(np.abs(x), 4))",
        also=("history",),
    ),
    _conv("relu6", "ReLU that ends at 6", _RELU, "return np.clip(x, 0, 6)"),
    _conv(
        "replicated", "replicates the border instead of zeros", _PAD, 'padded = np.pad(x, ((r, r), (r, r), (0, 0)), mode="edge")'
    ),
    _conv("row_above", "the window one row up", _PAD, "padded = np.pad(x, ((2 * r, 0), (r, r), (0, 0)))"),
    _conv("transposed", "rows and columns of the kernel swapped", _TAP_WEIGHT, "weight[:, :, v, u].T"),
    _conv("flipped", "convolution for cross-correlation", _TAP_WEIGHT, "weight[:, :, size - 1 - u, size - 1 - v].T"),
    _conv(
        "outputs_first",
        "outputs for inputs where there are as many",
        _TAP_WEIGHT,
        "(weight if inputs != outputs else weight.transpose(1, 0, 2, 3))[:, :, u, v].T",
        also=("history", "erm"),
    ),
    _conv("unbiased", "no bias", _BIAS, "y[...] = 0"),
    _conv("half_sum", "sums in half precision", _SUM, f"{_SUM}\n            y = y.astype(np.float16).astype(x.dtype)"),
    _conv("half_weights", "weights in half precision", _TAP_WEIGHT, "weight[:, :, u, v].T.astype(np.float16).astype(x.dtype)"),
    _conv(
        "tf32",
        "factors of 10 bits",
        _SUM,
        _SUM.replace("tap,", "tap.astype(np.float16).astype(x.dtype),").replace(
            "v].T", "v].T.astype(np.float16).astype(x.dtype)"
        ),
    ),
    _conv("tile_without_halo", "tiles of 16 rows do not see the row above", _SUM, _NO_HALO, also=("history", "decoder")),
)
