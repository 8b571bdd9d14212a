"""A case pins each constant of the specification: any other value gives an error above ten times the bound."""

import ast
from pathlib import Path

import numpy as np
import pytest

from conformance.cases.constants import CONSTANTS
from conformance.judging.findings import DepartureError
from conformance.judging.judge import Judge
from conformance.mistakes import find
from conformance.mistakes.holes import limits
from conformance.protocol.reference_copy import change_arguments, load, put, returns
from conformance.protocol.stages import STAGES
from conformance.suite import test_occlusion_warp
from conformance.suite.properties import find_property
from stss.port import ReferencePort
from stss_ref.reshade import FLOOR
from tests.meta import right_ports
from tests.tiers import every

ROOT = Path(__file__).parents[2]
BOUNDS = 10


def cosine(change):
    """The lengths of normals by another formula."""
    return put("holes.cosine", lambda normal, n: (normal * n).sum(axis=-1) / change(np.sqrt((n * n).sum(axis=-1))))


def normalise(change):
    return put("erm.normalise", lambda x: x / change(np.sqrt((x * x).sum(axis=-1, keepdims=True))))


def divide(change):
    return put("erm.divide", lambda total, weights: total / change(weights))


def apart(times):
    return put("holes.objects_apart", lambda s, stencil: times * np.abs(s - stencil))


def weigh_apart(times):
    """Another weight of the difference of base colours."""
    return change_arguments(
        "reshade.likeness", base_color=lambda base_color, own_base_color: own_base_color + times * (base_color - own_base_color)
    )


def brightness(most):
    """Base colours count up to another value."""
    return put("reshade.brightness", lambda base, mixed: np.where(mixed[:, None], 1, np.sqrt(np.clip(base, 0, most) + FLOOR)))


PLANTS = {
    "distance in footprints": [*(limits(footprints=x) for x in (1.49, 1.51, 0.0)), *find("holes_footprint_lost").plants],
    "distance head-on": [limits(facing=x) for x in (7.45, 7.55, 0.0)],
    "distance edge-on": [limits(grazing=x) for x in (44.8, 45.2, 0.0)],
    "distance by depth": [limits(depth=x) for x in (49.8, 50.2, 0.0)],
    "cosine": [limits(cosine=x) for x in (0.977, 0.983, np.float16(0.98), 0.0)],
    "what is added to a normal's length": [
        *(put("holes.LEAST_LENGTH", x) for x in (0, 1e-6, 1e-4, float(np.float16(1e-5)))),
        cosine(lambda length: np.maximum(length, 1e-5)),
        cosine(lambda length: np.sqrt(length * length + 1e-10)),
    ],
    "length of a background's normals": [
        put("holes.is_surface", lambda normal, n: ((n * n).sum(axis=-1) > 1e-12) | ((normal * normal).sum(axis=-1) > 1e-12))
    ],
    "length of a background's own normal": [put("reshade.is_background", lambda normal: (normal * normal).sum(axis=-1) < 1e-12)],
    "difference of stencils": [limits(mesh=x) for x in (0.99, 1.01, 0.0)],
    "stencil's channels": [apart(x) for x in (1, 2, 4)],
    "beginning of the depth buffer": [
        *(put("occlusion_warp.FARTHEST", x) for x in (1.0, 9.9, 10.1, np.finfo("f4").max)),
        put("occlusion_warp.FARTHEST", np.nextafter(10.0, 11)),
    ],
    "cosine of static surfaces": [limits(static_cosine=x) for x in (0.49, 0.51, -np.inf)],
    "own samples' cosine, static": [put("reshade.STATIC_COSINE", x) for x in (0.49, 0.51, -2.0)],
    "weight of distances on a background": [put("reshade.DISTANCE", x) for x in (0.24, 0.26, 0.0)],
    "own samples' distance in footprints": [put("reshade.FOOTPRINTS", x) for x in (1.99, 2.01, 0.0)],
    "own samples' cosine": [put("reshade.COSINE", x) for x in (0.947, 0.953, float(np.float16(0.95)), 0.0)],
    "places to the sides of a ring": [put("reshade.REACH", x) for x in (1, 3)],
    "pixels to the sides of the square of lights": [put("reshade.LIGHT_REACH", x) for x in (0, 1, 3)],
    "steps of the rings": [
        put("reshade.STEPS", x) for x in ((1, 2, 4, 8, 16), (2, 4, 8, 16, 32), (1, 2, 4, 8, 16, 31), (1, 2, 3, 4, 8, 16, 32))
    ],
    "weight of base colours": [weigh_apart(x) for x in (0.95, 1.05, 0.0)],
    "least a base colour reflects": [put("reshade.FLOOR", x) for x in (1 / 63, 1 / 65, 1e-6, float(np.float16(1e-2)))],
    "most a base colour reflects": [brightness(x) for x in (0.95, 1.05, 8.0)],
    "squared length of a mixed normal": [put("reshade.UNMIXED", x) for x in (0.249, 0.251, 0.0, 0.5)],
    "weight of normals": [put("reshade.NORMAL", x) for x in (1.95, 2.05, 0.0)],
    "power of a weight": [returns("reshade.likeness", lambda weight, p=p: weight**p) for p in (0.5, 0.99, 1.01)],
    "least length of a key": [
        normalise(lambda length: length + length.dtype.type(1e-12)),
        *(put("erm.LEAST_LENGTH", x) for x in (1e-11, 1e-13, 1e-30)),
    ],
    "least sum of weights": [
        divide(lambda total: total + total.dtype.type(1e-6)),
        divide(lambda total: np.where(total > 0, total, 1)),
        *(put("erm.LEAST_SUM", x) for x in (1e-7, 1e-5, 1e-38)),
        returns("erm.likeness", lambda weight: np.where(weight < 1e-7, 0, weight)),
    ],
    "window": [put("erm.WINDOW", x) for x in (3, 7)],
    "share of the newer image": [put("accumulate.EARLIER_SHARES", (x, 0.125)) for x in (0.24, 0.26, 0.375)],
    "share of the older image": [put("accumulate.EARLIER_SHARES", (0.25, x)) for x in (0.12, 0.13, 0.25)],
    "longest motion of a whole share": [put("accumulate.SLOW", x) for x in (2.0, 3.9, 4.1, 5.0, 8.0, 1e9)],
    "least colour": [find(f"frame_{name}").plants[0] for name in ("negative_color", "negative_history", "absolute_history")],
}


def judged(port, constant):
    judge = Judge(port)
    body = find_property(f"{constant.stage}.constants_are_those_of_the_specification")
    try:
        judge.check(body, constant.make(np.random.default_rng(0)))
    except AssertionError as error:
        return str(error), max(judge.record.worst.values())
    return "", max(judge.record.worst.values())


@pytest.mark.parametrize("constant", CONSTANTS, ids=lambda constant: constant.name)
def test_without_it_or_with_another_the_answer_is_far_off(constant):
    assert judged(ReferencePort(), constant)[0] == ""
    for i, plant in enumerate(PLANTS[constant.name]):
        message, worst = judged(load("planted", plant), constant)
        assert worst >= BOUNDS, (i, message, worst)


def test_a_failure_names_the_constant():
    judge = Judge(load("planted", PLANTS["beginning of the depth buffer"][0]), shrink=True)
    with pytest.raises(DepartureError, match=r"; the case is made for beginning of the depth buffer \(10\)"):
        test_occlusion_warp.test_constants_are_those_of_the_specification(judge)


@pytest.mark.parametrize("name", every(3, ["orders", "fma", "flush", "winograd_4", "half"]))
def test_right_ports_pass(name):
    for constant in CONSTANTS:
        assert judged(right_ports.port(name), constant)[0] == "", constant.name


def test_every_number_is_a_constant_that_has_plants():
    """Every constant has a plant, and every number of the reference's stages but 1/2, the place between two pixels, is a constant."""
    assert PLANTS.keys() == {constant.name for constant in CONSTANTS}
    values = {float(value) for constant in CONSTANTS for value in constant.value.split(",")}
    for stage in (*STAGES, "constants", "resample", "conv", "sample"):
        for node in ast.walk(ast.parse((ROOT / "stss_ref" / f"{stage}.py").read_text())):
            if isinstance(node, ast.Constant) and type(node.value) is float and node.value not in (0, 0.5):
                assert node.value in values, (stage, node.value)
