# SPDX-License-Identifier: MIT
"""Mistakes in stages network and frame."""

from collections.abc import Sequence

from conformance.mistakes.variants import Change, Mistake, fault

_NETWORK = "network.py"
_RESAMPLE = "resample.py"
_WIDTHS = "[(0, -height % 8), (0, -width % 8), (0, 0)]"
_PADDED = 'return np.pad(x, widths, mode="edge")'
_CROP = "return image[: 2 * height, : 2 * width]"
_CROP_BELOW = (_NETWORK, _CROP, "return image[image.shape[0] - 2 * height :, : 2 * width]")
_HISTORY = "history_embedding(history, weights)"
_MASK = "pad_to_8(mask[..., None])[..., 0],"
_NUMPY = (_NETWORK, "from stss_ref.arrays", "import numpy as np\n\nfrom stss_ref.arrays")


def _network(name: str, what: str, *change: str, more: Sequence[Change] = ()) -> Mistake:
    return fault("network", name, what, _NETWORK, *change, more=more)


def _pad(name: str, what: str, *change: str, more: Sequence[Change] = ()) -> Mistake:
    return fault("network", name, what, _RESAMPLE, *change, more=more)


NETWORK = (
    _pad("padded_with_zeros", "pads to multiples of 8 with zeros", _PADDED, "return np.pad(x, widths)"),
    _pad("padded_by_mirror", "pads with the mirror image", _PADDED, 'return np.pad(x, widths, mode="symmetric")'),
    _pad(
        "padded_above", "pads above and crops above", _WIDTHS, "[(-height % 8, 0), (0, -width % 8), (0, 0)]", more=[_CROP_BELOW]
    ),
    _pad("padded_left", "pads left, crops right", _WIDTHS, "[(0, -height % 8), (-width % 8, 0), (0, 0)]"),
    _pad("padded_always", "pads by 8 where nothing is missing", _WIDTHS, "[(0, 8 - height % 8), (0, 8 - width % 8), (0, 0)]"),
    _pad("padded_to_16", "pads to multiples of 16", _WIDTHS, "[(0, -height % 16), (0, -width % 16), (0, 0)]"),
    _network("cropped_above", "crops the first rows", *_CROP_BELOW[1:]),
    _network(
        "mask_padded_with_zeros",
        "what is padded is a hole",
        _MASK,
        "np.pad(mask, ((0, -height % 8), (0, -width % 8))),",
        more=[_NUMPY],
    ),
    _network(
        "history_padded_with_zeros",
        "pads the history with zeros",
        "pad_to_8(history),",
        "np.pad(history, ((0, 0), (0, -height % 8), (0, -width % 8), (0, 0))),",
        more=[_NUMPY],
    ),
    _network("history_reversed", "history newest first", _HISTORY, "history_embedding(history[::-1], weights)"),
    _network("erm_unmasked", "no mask in the ERM", "erm(x4, gbuffer, mask, weights)", "erm(x4, gbuffer, mask * 0 + 1, weights)"),
    _network(
        "mask_inverted",
        "1 - mask",
        "x4 = encoder(color, gbuffer, mask, weights)",
        "x4 = encoder(color, gbuffer, (mask := 1 - mask), weights)",
    ),
    _network("clipped", "clips the image to [0, 1]", _CROP, f"{_CROP}.clip(0, 1)"),
    _network(
        "weights_in_half",
        "weights in half precision",
        "astype(weights, color.dtype)",
        'astype(astype(weights, "float16"), color.dtype)',
    ),
)

_FRAME = "frame.py"
_CHAINED = "motions.get(step), test)"
_STEPS = "enumerate(chained, start=1)"
_MISSING = "missing = i > 0 and step == inputs.steps[i - 1]"
_VALIDS = "valids.append(np.zeros_like(valid) if missing else valid)"
_COLOR = "color = np.maximum(np.concatenate([instead, other], axis=-1), 0)"
_STACK = "history = np.stack([np.concatenate([np.maximum(w, 0), m], axis=-1) for w, m in zip(warped, masks, strict=True)])"
_FILL = "_, instead = occlusion_warp(inputs.colors[0], newest, motion, inputs.gbuffer[..., 3], valids[0])"
_MASK_OUT = "masks[0][..., 0], "
_WARPED = "warped.append(w)"
_ONE = "w, valid = _warp_one(inputs, i, motions.get(step), test)"


def _frame(name: str, what: str, *change: str, more: Sequence[Change] = ()) -> Mistake:
    return fault("frame", name, what, _FRAME, *change, more=more)


def _trusted(mask: str, picture: str, otherwise: str = "newest") -> str:
    return f"np.where({mask}[..., None], {picture}, {otherwise})"


_EARLIER = _trusted("valids[1]", "warped[1]")
_SWAPPED = '([other, instead] if second == "earlier" else [instead, other])'


def _second(name: str, what: str, picture: str) -> Mistake:
    """The second colour of weights that want an earlier one is ``picture``."""
    right = f'other = {_EARLIER} if second == "earlier" else newest'
    return _frame(f"second_{name}", what, right, f'other = ({picture}) if second == "earlier" else newest')


_SECONDS = (
    _second("ignored", "the newest frame is the second colour, whatever the weights say", "newest"),
    _second("unmasked", "the earlier frame is the second colour in its holes, too", "warped[1]"),
    _second("of_oldest", "the oldest frame for the earlier one as the second colour", _trusted("valids[2]", "warped[2]")),
    _second("by_newest_mask", "the newest frame's holes for the earlier one's", _trusted("valids[0]", "warped[1]")),
    _second("black_in_holes", "the second colour is black in the earlier frame's holes", _trusted("valids[1]", "warped[1]", "0")),
    _second("not_warped", "the earlier frame is the second colour, but not warped", _trusted("valids[1]", "inputs.colors[1]")),
    _second(
        "missing_trusted",
        "a missing earlier frame is the second colour",
        _trusted("(valids[1] | (inputs.steps[1] == inputs.steps[0]))", "warped[1]"),
    ),
    _second("ef_only", "an SF's second colour is the newest frame", f"{_EARLIER} if inputs.steps[0] > 0 else newest"),
    _second("sf_only", "an EF's second colour is the newest frame", f"{_EARLIER} if inputs.steps[0] == 0 else newest"),
    _frame("second_first", "the earlier frame is the first colour", _COLOR, _COLOR.replace("[instead, other]", _SWAPPED)),
    _frame(
        "second_filled",
        "the second colour is filled, not warped, in the earlier frame's holes",
        _COLOR,
        _COLOR.replace("other]", 'np.where(valids[1][..., None] | (second == "newest"), other, instead)]'),
    ),
)

FRAME = (
    _frame("newest_motion_for_all", "one motion for the three colours", _CHAINED, "motions.get(inputs.steps[0]), test)"),
    _frame("one_step_too_far", "each motion one frame too far", _STEPS, "enumerate(chained, start=0)"),
    _frame("one_step_short", "each motion one frame short", _STEPS, "enumerate(chained, start=2)"),
    _frame(
        "steps_ignored",
        "every frame an EF of 1, 3, 5",
        "    _check(inputs)\n",
        "    _check(inputs)\n    inputs = replace(inputs, steps=(1, 3, 5)) if len(inputs.motions) > 4 else inputs\n",
        more=[(_FRAME, "import dataclass", "import dataclass, replace")],
    ),
    _frame(
        "motions_oldest_first",
        "motions taken as oldest first",
        "chain_steps(motions[: max(steps)], gather)",
        "chain_steps(motions[: max(steps)][::-1], gather)",
    ),
    _frame(
        "last_motions", "takes the last motions, of more than the steps need", "motions[: max(steps)]", "motions[-max(steps) :]"
    ),
    _frame(
        "lost_motion_is_still",
        "motion that is not finite counts as 0",
        "warped, _ = warp(inputs.colors[i], motion)",
        "motion = np.where(np.isfinite(motion).all(axis=-1, keepdims=True), motion, 0)\n    warped, _ = warp(inputs.colors[i], motion)",
    ),
    _frame(
        "lost_position_is_0",
        "a position that is not finite counts as 0",
        "position_previous=inputs.positions[i + 1]",
        "position_previous=np.nan_to_num(inputs.positions[i + 1], posinf=0, neginf=0)",
    ),
    _frame(
        "nearest_chain",
        "the chain by the nearest pixel",
        'def frame(inputs: FrameInputs, weights: Weights, gather: Gather = "longest")',
        'def frame(inputs: FrameInputs, weights: Weights, gather: Gather = "nearest")',
    ),
    _frame("hole_test_ignored", "always the footprint's hole test", ", weights.hole_test)", ")"),
    _frame(
        "stencil_of_now",
        "the current stencils for the earlier ones",
        "stencil_previous=inputs.stencils[i + 1]",
        "stencil_previous=inputs.stencils[0]",
    ),
    _frame(
        "stencil_of_newest",
        "the newest colour's stencils throughout",
        "stencil_previous=inputs.stencils[i + 1]",
        "stencil_previous=inputs.stencils[1]",
    ),
    _frame(
        "normal_one_off",
        "normals of the next newer frame",
        "normal_previous=inputs.normals[i + 1]",
        "normal_previous=inputs.normals[i]",
    ),
    _frame(
        "normal_of_newest",
        "the newest colour's normals throughout",
        "normal_previous=inputs.normals[i + 1]",
        "normal_previous=inputs.normals[1]",
    ),
    _frame(
        "position_one_off",
        "positions of the next newer frame",
        "position_previous=inputs.positions[i + 1]",
        "position_previous=inputs.positions[i]",
    ),
    _frame(
        "position_of_newest",
        "the newest colour's positions throughout",
        "position_previous=inputs.positions[i + 1]",
        "position_previous=inputs.positions[1]",
    ),
    _frame(
        "roughness_for_depth", "roughness for depth in the holes", "depth=inputs.gbuffer[..., 3]", "depth=inputs.gbuffer[..., 4]"
    ),
    _frame("splat_by_roughness", "roughness for depth in the splat", _FILL, _FILL.replace("3]", "4]")),
    _frame("missing_not_masked", "a missing frame keeps its mask", _MISSING, "missing = False"),
    _frame(
        "missing_by_newest",
        "missing only where the step is the newest's",
        _MISSING,
        "missing = i > 0 and step == inputs.steps[0]",
    ),
    _frame(
        "missing_is_black",
        "a missing frame has no colours",
        _WARPED,
        "warped.append(w * (not (i > 0 and step == inputs.steps[i - 1])))",
    ),
    _frame(
        "missing_not_warped",
        "a missing frame is not warped again",
        _ONE,
        "w, valid = _warp_one(inputs, i, None if i > 0 and step == inputs.steps[i - 1] else motions.get(step), test)",
    ),
    _frame(
        "sf_without_holes",
        "an SF's older frames have no holes",
        _VALIDS,
        "valids.append(np.zeros_like(valid) if missing else valid | (inputs.steps[0] == 0))",
    ),
    _frame(
        "holes_not_masked",
        "only off screen is a hole",
        "warped, _ = warp(inputs.colors[i], motion)",
        "warped, inside = warp(inputs.colors[i], motion)",
        more=[(_FRAME, "return warped, valid", "return warped, inside | valid")],
    ),
    _frame("warped_first", "warped before occlusion_warp", _COLOR, _COLOR.replace("[instead, other]", "[newest, instead]")),
    _frame(
        "warped_twice", "warped in the place of occlusion_warp", _COLOR, _COLOR.replace("[instead, other]", "[newest, newest]")
    ),
    _frame(
        "filled_twice", "occlusion_warp in the place of warped", _COLOR, _COLOR.replace("[instead, other]", "[instead, instead]")
    ),
    _frame("filled_from_middle", "fills from the middle frame", _FILL, _FILL.replace("colors[0]", "colors[1]")),
    _frame(
        "filled_by_oldest_motion",
        "fills by the oldest frame's motion",
        _FILL,
        _FILL.replace("newest, motion", "newest, motions[inputs.steps[2]]"),
    ),
    _frame("filled_everywhere", "fills what needs no filling", _FILL, _FILL.replace("valids[0]", "valids[0] & False")),
    _frame(
        "history_newest_first", "history newest first", "np.ascontiguousarray(history[::-1])", "np.ascontiguousarray(history)"
    ),
    _frame(
        "history_filled", "occlusion_warp in the history", _STACK, _STACK.replace("zip(warped,", "zip([instead, *warped[1:]],")
    ),
    _frame(
        "history_masked",
        "the history's colours times their masks",
        _STACK,
        _STACK.replace("np.maximum(w, 0), m]", "np.maximum(w, 0) * m, m]"),
    ),
    _frame(
        "history_mask_of_newest",
        "the newest mask with all three",
        _STACK,
        _STACK.replace("zip(warped, masks,", "zip(warped, masks[:1] * 3,"),
    ),
    _frame("mask_of_oldest", "the oldest mask as the network's", _MASK_OUT, "masks[2][..., 0], "),
    _frame("mask_of_all", "the network's mask: valid in all three", _MASK_OUT, "(masks[0] * masks[1] * masks[2])[..., 0], "),
    _frame("mask_all_valid", "the network's mask all 1", _MASK_OUT, "masks[0][..., 0] * 0 + 1, "),
    *_SECONDS,
    _frame("negative_color", "colours below 0 stay", _COLOR, "color = np.concatenate([instead, other], axis=-1)"),
    _frame("negative_history", "colours below 0 stay in the history", _STACK, _STACK.replace("np.maximum(w, 0)", "w")),
    _frame(
        "color_up_to_1", "colours above 1 become 1", _COLOR, "color = np.clip(np.concatenate([instead, other], axis=-1), 0, 1)"
    ),
    _frame(
        "history_up_to_1",
        "colours above 1 become 1 in the history",
        _STACK,
        _STACK.replace("np.maximum(w, 0)", "np.clip(w, 0, 1)"),
    ),
)
