# SPDX-License-Identifier: MIT
"""Mistakes in stages erm and decoder."""

from collections.abc import Sequence
from typing import Any

from conformance.mistakes.variants import Change, Mistake, fault

_ERM = "erm.py"
_RESAMPLE = "resample.py"
_LIGHT = 'light = conv_chain(np.concatenate([x4, f], axis=-1), weights, "latentEncoder", (1, 1, 1), last_relu=False) * m'
_MATERIAL = 'material = normalise(conv_chain(f, weights, "KEncoder", (1, 1, 1), last_relu=False))'
_ATTEND = "return attend(material, material * m, light)"
_SMALL = "f, m = downsample_8(gbuffer), downsample_8(mask[..., None])"
_PAD = "np.pad(a, ((r, r), (r, r), (0, 0)))"
_WEIGHT = "weight = np.maximum((key[there] * query).sum(axis=-1, keepdims=True), 0)"
_TOTAL = "total += weight * value[there]"
_QUOTIENT = "return total / np.maximum(weight_sum, weight_sum.dtype.type(1e-6))"
_LENGTH = "np.maximum(np.sqrt((x * x).sum(axis=-1, keepdims=True)), x.dtype.type(1e-12))"
_ROWS = "x = (x[3::8] + x[4::8]) * half"
_COLUMNS = "return (x[:, 3::8] + x[:, 4::8]) * half"
_OWN_LEFT_OUT = f"""if u == v == r:
                continue
            {_WEIGHT}"""


def _erm(name: str, what: str, *change: str, more: Sequence[Change] = (), **marks: Any) -> Mistake:
    return fault("erm", name, what, _ERM, *change, more=more, **marks)


def _down(name: str, what: str, rows: str, columns: str) -> Mistake:
    return fault("erm", name, what, _RESAMPLE, _ROWS, rows, more=[(_RESAMPLE, _COLUMNS, columns)])


ERM = (
    _erm("window_3", "3 x 3", "WINDOW = 5", "WINDOW = 3"),
    _erm("window_7", "7 x 7", "WINDOW = 5", "WINDOW = 7"),
    _erm("window_shifted", "the window one row up", _PAD, "np.pad(a, ((r + 1, r - 1), (r, r), (0, 0)))"),
    _erm("window_clamped", "replicates the border instead of zeros", _PAD, 'np.pad(a, ((r, r), (r, r), (0, 0)), mode="edge")'),
    _erm("own_pixel_left_out", "the window's own pixel takes no part", _WEIGHT, _OWN_LEFT_OUT),
    _erm(
        "value_mirrored",
        "V(p - d) for V(p + d)",
        _TOTAL,
        "total += weight * value[2 * r - v : 2 * r - v + height, 2 * r - u : 2 * r - u + width]",
    ),
    _erm("key_unmasked", "the key is not masked", _ATTEND, "return attend(material, material, light)"),
    _erm("key_mask_inverted", "the key times 1 - m", _ATTEND, "return attend(material, material * (1 - m), light)"),
    _erm("query_masked", "masks the query instead of the key", _ATTEND, "return attend(material * m, material, light)"),
    _erm("query_masked_too", "masks query and key", _ATTEND, "return attend(material * m, material * m, light)"),
    _erm("value_unmasked", "the value is not masked", "last_relu=False) * m", "last_relu=False)"),
    _erm("value_mask_inverted", "the value times 1 - m", "last_relu=False) * m", "last_relu=False) * (1 - m)"),
    _erm("value_masked_twice", "the value times m m", "last_relu=False) * m", "last_relu=False) * m * m"),
    _erm("mask_yes_or_no", "a mask of 1/4 is 1", _SMALL, f"{_SMALL}\n    m = (m > 0).astype(m.dtype)"),
    _erm("mask_threshold", "a mask below 1 is 0", _SMALL, f"{_SMALL}\n    m = (m == 1).astype(m.dtype)"),
    _erm("gbuffer_first", "f before x4", _LIGHT, _LIGHT.replace("[x4, f]", "[f, x4]")),
    _erm("light_relu", "ReLU after the last layer of latentEncoder", _LIGHT, _LIGHT.replace(", last_relu=False", "")),
    _erm("material_relu", "ReLU after the last layer of KEncoder", _MATERIAL, _MATERIAL.replace(", last_relu=False", "")),
    _erm("not_normalised", "K is not normalised", _MATERIAL, _MATERIAL.replace("normalise(", "(")),
    _erm(
        "not_rooted",
        "divides by the length's square",
        _LENGTH,
        "np.maximum((x * x).sum(axis=-1, keepdims=True), x.dtype.type(1e-12))",
    ),
    _erm(
        "epsilon_added", "adds 1e-3 to the length", _LENGTH, "(np.sqrt((x * x).sum(axis=-1, keepdims=True)) + x.dtype.type(1e-3))"
    ),
    _erm(
        "epsilon_inside", "adds 1e-5 under the root", _LENGTH, "np.sqrt((x * x).sum(axis=-1, keepdims=True) + x.dtype.type(1e-5))"
    ),
    _erm("weight_relu_missing", "weights may be negative", _WEIGHT, "weight = (key[there] * query).sum(axis=-1, keepdims=True)"),
    _erm("weight_absolute", "|w| for relu(w)", _WEIGHT, "weight = np.abs((key[there] * query).sum(axis=-1, keepdims=True))"),
    _erm("softmax", "exp for ReLU", _WEIGHT, "weight = np.exp((key[there] * query).sum(axis=-1, keepdims=True))"),
    _erm("undivided", "as in the paper: not divided by the sum", _QUOTIENT, "return total"),
    _erm("mean", "divides by the number of pixels", _QUOTIENT, "return total / WINDOW**2"),
    _erm("unclamped_sum", "0 / 0 where nothing is to be trusted", _QUOTIENT, "return total / weight_sum"),
    _erm("sum_epsilon", "adds 1e-3 to the sum", _QUOTIENT, "return total / (weight_sum + weight_sum.dtype.type(1e-3))"),
    _erm("half_weight", "weights in half precision", _WEIGHT, f"{_WEIGHT}.astype(np.float16).astype(query.dtype)"),
    _erm(
        "half_sum",
        "sums in half precision",
        _TOTAL,
        f"{_TOTAL}\n            total = total.astype(np.float16).astype(value.dtype)",
    ),
    _down(
        "down_4_and_5", "pixels 8i + 4 and 8i + 5", "x = (x[4::8] + x[5::8]) * half", "return (x[:, 4::8] + x[:, 5::8]) * half"
    ),
    _down("down_first", "pixel 8i", "x = x[::8]", "return x[:, ::8]"),
    _down("down_nearest", "pixel 8i + 4", "x = x[4::8]", "return x[:, 4::8]"),
    _down("down_rows_only", "two rows, one column", _ROWS, "return x[:, 4::8]"),
    _down(
        "down_mean",
        "the mean of the 8 x 8 block",
        "x = x.reshape(len(x) // 8, 8, *x.shape[1:]).mean(axis=1)",
        "return x.reshape(len(x), -1, 8, x.shape[2]).mean(axis=2)",
    ),
)

_DECODER = "decoder.py"
_FEATURES = "u = np.concatenate([reshaded, feature], axis=-1)"
_SKIP = "u = np.concatenate([skip, upsample_corners(u)], axis=-1)"
_UP = 'u = conv_chain(u, weights, f"{name}.conv.double_conv", (1, 1))'
_RESULT = 'return pixel_shuffle(conv_named(u, weights, "outc")) + upsample_centres(color[..., :3])'
_BASE = "upsample_centres(color[..., :3])"
_SHUFFLE = "return blocks.transpose(0, 3, 1, 4, 2)"
_BLOCKS = "blocks = x.reshape(height, width, channels // 4, 2, 2)"
_CORNERS = "np.arange(2 * n) * ((n - 1) / (2 * n - 1))"
_CENTRES = "np.clip((np.arange(2 * n) + 0.5) / 2 - 0.5, 0, n - 1)"
_LERP = "t = (at - low).astype(x.dtype)"
_FIRST_RELU_MISSING = """u = conv_named(u, weights, f"{name}.conv.double_conv.0")
        u = np.maximum(conv_named(u, weights, f"{name}.conv.double_conv.2"), 0)"""


def _decoder(name: str, what: str, *change: str, more: Sequence[Change] = ()) -> Mistake:
    return fault("decoder", name, what, _DECODER, *change, more=more)


def _resample(name: str, what: str, *change: str, **marks: Any) -> Mistake:
    return fault("decoder", name, what, _RESAMPLE, *change, **marks)


DECODER = (
    _resample(
        "shuffle_transposed", "rows and columns of the pixel shuffle swapped", _SHUFFLE, "return blocks.transpose(0, 4, 1, 3, 2)"
    ),
    _resample(
        "shuffle_color_fastest",
        "depth to space with the colour fastest",
        _SHUFFLE,
        "return blocks.transpose(0, 1, 3, 2, 4)",
        more=[(_RESAMPLE, _BLOCKS, "blocks = x.reshape(height, width, 2, 2, channels // 4).transpose(0, 2, 1, 3, 4)")],
    ),
    _resample(
        "shuffle_upside_down",
        "rows of the pixel shuffle from below",
        _SHUFFLE,
        "return blocks[..., ::-1, :].transpose(0, 3, 1, 4, 2)",
    ),
    _resample("corners_as_halves", "corners aligned: o / 2", _CORNERS, "np.arange(2 * n) / 2"),
    _resample("corners_over_n", "corners aligned: o (n - 1) / N", _CORNERS, "np.arange(2 * n) * ((n - 1) / (2 * n))"),
    _resample(
        "centres_unclamped",
        "centres aligned: before the first pixel comes the last",
        _CENTRES,
        "(np.arange(2 * n) + 0.5) / 2 - 0.5",
    ),
    _resample("centres_as_halves", "centres aligned: o / 2", _CENTRES, "np.arange(2 * n) / 2"),
    _resample(
        "texture_fraction",
        "a texture sampler, whose fraction has 8 bits",
        _LERP,
        "t = (np.floor((at - low) * 256) / 256).astype(x.dtype)",
    ),
    _decoder("features_by_centres", "features upsampled with centres aligned", _SKIP, _SKIP.replace("corners", "centres")),
    _decoder(
        "features_nearest",
        "features upsampled by repeating pixels",
        _SKIP,
        "u = np.concatenate([skip, u.repeat(2, 0).repeat(2, 1)], axis=-1)",
    ),
    _decoder("base_by_corners", "colour upsampled with corners aligned", _RESULT, _RESULT.replace("centres", "corners")),
    _decoder("base_nearest", "colour upsampled by repeating pixels", _BASE, "color[..., :3].repeat(2, 0).repeat(2, 1)"),
    _decoder("base_missing", "the residual alone", _RESULT, 'return pixel_shuffle(conv_named(u, weights, "outc"))'),
    _decoder("base_of_warped", "adds warped, not occlusion_warp", _BASE, "upsample_centres(color[..., 3:])"),
    _decoder("base_bgr", "adds the colours in reverse", _BASE, "upsample_centres(color[..., 2::-1])"),
    _decoder(
        "residual_subtracted",
        "the residual with the other sign",
        _RESULT,
        'return -pixel_shuffle(conv_named(u, weights, "outc")) + upsample_centres(color[..., :3])',
    ),
    _decoder(
        "outc_relu",
        "ReLU after outc",
        _RESULT,
        _RESULT.replace('conv_named(u, weights, "outc")', 'np.maximum(conv_named(u, weights, "outc"), 0)'),
    ),
    _decoder("clipped", "clips the image to [0, 1]", _RESULT, f"{_RESULT.replace('return ', 'return np.clip(')}, 0, 1)"),
    _decoder("history_first", "feature before reshaded", _FEATURES, "u = np.concatenate([feature, reshaded], axis=-1)"),
    _decoder(
        "skip_last", "the skip after the upsampled features", _SKIP, "u = np.concatenate([upsample_corners(u), skip], axis=-1)"
    ),
    _decoder("first_relu_missing", "no ReLU between the two convolutions", _UP, _FIRST_RELU_MISSING),
    _decoder(
        "second_relu_missing", "no ReLU after the two convolutions", _UP, _UP.replace("(1, 1))", "(1, 1), last_relu=False)")
    ),
)
