"""The errors of the functions in `docs/api.md` for wrong arrays: one line that names the array."""

from functools import partial

import numpy as np
import pytest

from conformance.protocol.stages import STAGES
from stss_ref import weights as tensors
from stss_ref.accumulate import accumulate
from stss_ref.arrays import ArrayError, require, require_dtype
from stss_ref.decoder import decoder
from stss_ref.depth import normalise_depth
from stss_ref.encoder import encoder
from stss_ref.erm import erm
from stss_ref.frame import FrameInputs, frame
from stss_ref.history import history_embedding
from stss_ref.holes import holes
from stss_ref.loss import loss
from stss_ref.motion_chain import motion_chain
from stss_ref.network import network
from stss_ref.occlusion_warp import occlusion_warp
from stss_ref.reshade import reshade
from stss_ref.rrm import rrm
from stss_ref.warp import warp

H, W = 8, 16
WEIGHTS = tensors.zeros()
NOT_REFUSED = {"motion", "motions", "position", "positions", "position_previous"}
"""Those that may hold NaN (decision 3); so may `normalise_depth`'s view depth."""


def compute_frame(**arrays):
    return frame(FrameInputs(steps=(1, 2, 3), **arrays), WEIGHTS)


SURFACE = {
    "stencil_previous": (H, W), "stencil": (H, W), "normal_previous": (H, W, 3), "normal": (H, W, 3),
    "position_previous": (H, W, 3), "position": (H, W, 3),
}  # fmt: skip
FUNCTIONS = {
    warp: {"color": (H, W, 3), "motion": (H, W, 2)},
    motion_chain: {"motions": (2, H, W, 2)},
    holes: {"motion": (H, W, 2), **SURFACE, "nov": (H, W), "depth": (H, W)},
    occlusion_warp: {"color": (H, W, 3), "warped": (H, W, 3), "motion": (H, W, 2), "depth": (H, W), "valid": (H, W)},
    reshade: {"color": (H, W, 3), "warped": (H, W, 3), "motion": (H, W, 2), "valid": (H, W), **SURFACE, "base_color": (H, W, 3)},
    lambda valid: rrm(valid, (1, 1, 2, 2)): {"valid": (H, W)},
    accumulate: {"image": (2 * H, 2 * W, 3), "earlier": (2, 2 * H, 2 * W, 3), "motions": (2, H, W, 2)},
    lambda depth: normalise_depth(depth, "scale"): {"depth": (H, W)},
    lambda **a: history_embedding(weights=WEIGHTS, **a): {"history": (3, H, W, 4)},
    lambda **a: encoder(weights=WEIGHTS, **a): {"color": (H, W, 6), "gbuffer": (H, W, 9), "mask": (H, W)},
    lambda **a: erm(weights=WEIGHTS, **a): {"x4": (1, 2, 32), "gbuffer": (H, W, 9), "mask": (H, W)},
    lambda **a: decoder(weights=WEIGHTS, **a): {
        "reshaded": (1, 2, 64), "feature": (1, 2, 32), "x1": (H, W, 24), "x2": (4, 8, 24), "x3": (2, 4, 32), "color": (H, W, 6),
    },
    lambda **a: network(weights=WEIGHTS, **a): {"color": (H, W, 6), "gbuffer": (H, W, 9), "mask": (H, W), "history": (3, H, W, 4)},
    compute_frame: {
        "colors": (3, H, W, 3), "motions": (3, H, W, 2), "gbuffer": (H, W, 9), "nov": (H, W), "stencils": (4, H, W),
        "normals": (4, H, W, 3), "positions": (4, H, W, 3),
    },
    loss: {"output": (2 * H, 2 * W, 3), "truth": (2 * H, 2 * W, 3), "mask": (H, W)},
}  # fmt: skip
CASES = [
    pytest.param(function, name, id=f"{'-'.join(shapes)[:24]}-{name}")
    for function, shapes in FUNCTIONS.items()
    for name in shapes
]


def test_every_stage_is_tried():
    """It is known by the names of its planes."""
    tried = [shapes.keys() for shapes in FUNCTIONS.values()]
    planes = {stage.name: {name for name, spec in stage.inputs.items() if spec.kind != "int"} for stage in STAGES.values()}
    assert not [stage for stage, names in planes.items() if names not in tried]


def with_nan(array):
    array[(0,) * array.ndim] = np.nan
    return array


WRONG = {
    "an axis more": lambda a: a[None], "an axis less": lambda a: a[0], "no rows": lambda a: a[..., :0, :],
    "a channel more": lambda a: np.concatenate([a, a[..., :1]], axis=-1),
    "integers": lambda a: a.astype(np.int32), "half": lambda a: a.astype(np.float16), "complex": lambda a: a.astype(complex),
    "words": lambda a: a.astype(str), "objects": lambda a: a.astype(object), "a list": lambda a: a.tolist(), "nothing": lambda a: None,
    "a number": lambda a: 5,
}  # fmt: skip


@pytest.mark.parametrize(("function", "name"), CASES)
def test_what_is_not_taken_is_named(function, name):
    arrays = {each: np.full(shape, 0.5, np.float32) for each, shape in FUNCTIONS[function].items()}
    function(**arrays)
    alone = len(arrays) == 1 or (name in ("color", "output") and len(arrays) <= 3)
    for what, change in WRONG.items():
        if what == "a channel more" and alone and arrays[name].shape[-1] in (3, 16):
            continue  # any number of channels, or of columns, is one
        with pytest.raises(ArrayError) as error:
            function(**{**arrays, name: change(arrays[name])})
        assert "\n" not in str(error.value)
        names, *_ = str(error.value).partition(":")
        # Of two arrays that do not fit each other, the later one is named.
        assert names == name or (names in arrays and what in ("a channel more", "no rows")), (what, str(error.value))
    if len(arrays) > 1 and name != "valid":
        with pytest.raises(ArrayError, match="expected dtype"):
            function(**{**arrays, name: arrays[name].astype(np.float64)})
    broken = {**arrays, name: with_nan(arrays[name].copy())}
    if function is holes and name in ("nov", "depth"):  # the paper's test alone reads them
        function(**broken)
        function = partial(holes, test="paper")
    if name in NOT_REFUSED or FUNCTIONS.get(function) == {"depth": (H, W)}:
        function(**broken)
    else:
        with pytest.raises(ArrayError, match=rf"^{name}: 1 non-finite values, first at index \(0, 0"):
            function(**broken)


@pytest.mark.parametrize("kind", [bool, np.uint8, np.float32])
def test_a_mask_of_trust_may_be_of_three_kinds(kind):
    valid = np.ones((H, W), kind)
    assert rrm(valid, (0, 0, 2, 3)).dtype == kind
    rest = {name: np.zeros(shape, np.float32) for name, shape in FUNCTIONS[occlusion_warp].items() if name != "valid"}
    occlusion_warp(valid=valid, **rest)


def test_letters_stand_for_one_length_each():
    x, y = np.zeros((2, 3)), np.zeros((6, 2))
    assert require({"x": (x, "a, b"), "y": (y, "2b, a")}) == {"a": 2, "b": 3}
    assert require({"y": (y, "2b, 2")}) == {"b": 3}
    for words, expected in (("3b, a", r"\(9, 2\)"), ("b, 4", r"\(3, 4\)")):
        with pytest.raises(ArrayError, match=rf"^y: expected shape {expected}, got \(6, 2\)$"):
            require({"x": (x, "a, b"), "y": (y, words)})
    with pytest.raises(ArrayError, match=r"^y: expected shape \(4, 2\), got \(6, 2\)$"):
        require({"y": (y, "4b, 2")})


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: motion_chain(np.zeros((1, 2, 2, 2)), "furthest"), "gather: expected longest or "),
        (lambda: motion_chain(np.zeros((1, 2, 2, 2)), ["longest"]), "gather: expected longest or nearest or bilinear, got list"),
        (lambda: motion_chain(np.zeros((2, 2, 2))), "motions: expected shape (any, any, any, 2), got (2, 2, 2)"),
        (lambda: normalise_depth(np.ones((2, 2)), "log"), "mode: expected clip or scale, got 'log'"),
        (lambda: holes(*(np.zeros(s, np.float32) for s in FUNCTIONS[holes].values()), test="mine"), "test: expected "),
        (lambda: rrm(np.ones((8, 8)), (1, 2, 3)), r"rectangle: expected shape (4,), got (3,)"),
        (lambda: rrm(np.ones((8, 8)), 5), r"rectangle: expected shape (4,), got ()"),
    ],
)  # fmt: skip
def test_other_arguments_are_named(call, words):
    with pytest.raises(ArrayError) as error:
        call()
    assert str(error.value).startswith(words)


def test_one_dtype_is_required():
    require_dtype("x", np.zeros(3, np.float32), np.dtype(np.float32))
    with pytest.raises(ArrayError, match=r"^x: expected dtype float32, got int64$"):
        require_dtype("x", np.zeros(3, np.int64), np.dtype(np.float32))
