"""Each constant of the specification is pinned by a case: whatever takes its place is beyond ten times the bound."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest

from conformance.cases.constants import CONSTANTS
from conformance.judging.findings import DepartureError
from conformance.judging.judge import Judge
from conformance.mistakes.variants import load
from conformance.protocol.stages import STAGES
from conformance.suite import test_occlusion_warp
from conformance.suite.properties import find_property
from stss.port import ReferencePort
from tests.meta import right_ports

ROOT = Path(__file__).parents[2]
BOUNDS = 10
SUM = "np.maximum(weight_sum, weight_sum.dtype.type(1e-6))"
LENGTH = "np.maximum(np.sqrt((x * x).sum(axis=-1, keepdims=True)), x.dtype.type(1e-12))"
NORMAL = "(length + length.dtype.type(1e-5))"
FRAME = "color = np.maximum(np.concatenate([instead, other], axis=-1), 0)"
HISTORY = "np.maximum(w, 0)"
PLANTS = {
    "distance in footprints": [
        ("constants.py", "footprints: float = 1.5", f"footprints: float = {x}") for x in (1.49, 1.51, 0.0)
    ],
    "distance head-on": [("constants.py", "facing: float = 7.5", f"facing: float = {x}") for x in (7.45, 7.55, 0.0)],
    "distance edge-on": [("constants.py", "grazing: float = 45.0", f"grazing: float = {x}") for x in (44.8, 45.2, 0.0)],
    "distance by depth": [("constants.py", "depth: float = 50.0", f"depth: float = {x}") for x in (49.8, 50.2, 0.0)],
    "cosine": [("constants.py", "cosine: float = 0.98", f"cosine: float = {x}") for x in (0.977, 0.983, 0.0)],
    "what is added to a normal's length": [
        ("holes.py", NORMAL, new)
        for new in (
            "length",
            "np.maximum(length, 1e-5)",
            NORMAL.replace("1e-5", "1e-6"),
            NORMAL.replace("1e-5", "1e-4"),
            "np.sqrt(length * length + 1e-10)",
        )
    ],
    "difference of stencils": [("constants.py", "mesh: float = 1.0", f"mesh: float = {x}") for x in (0.99, 1.01, 0.0)],
    "stencil's channels": [("holes.py", "mesh = 3 * np", f"mesh = {x} * np") for x in (1, 2, 4)],
    "beginning of the depth buffer": [
        *(("occlusion_warp.py", "FARTHEST = 10.0", f"FARTHEST = {x}") for x in (1.0, 9.9, 10.1, np.finfo("f4").max)),
        ("occlusion_warp.py", "(depth < FARTHEST)", "(depth <= FARTHEST)"),
    ],
    "least length of a key": [
        ("erm.py", LENGTH, new)
        for new in (
            "(np.sqrt((x * x).sum(axis=-1, keepdims=True)) + x.dtype.type(1e-12))",
            LENGTH.replace("1e-12", "1e-11"),
            LENGTH.replace("1e-12", "1e-13"),
            LENGTH.replace("1e-12", "1e-30"),
        )
    ],
    "least sum of weights": [
        ("erm.py", SUM, new)
        for new in (
            "(weight_sum + weight_sum.dtype.type(1e-6))",
            SUM.replace("1e-6", "1e-7"),
            SUM.replace("1e-6", "1e-5"),
            SUM.replace("1e-6", "1e-38"),
            "np.where(weight_sum > 0, weight_sum, 1)",
        )
    ],
    "window": [("erm.py", "WINDOW = 5", f"WINDOW = {x}") for x in (3, 7)],
    "least colour": [
        ("frame.py", FRAME, "color = np.concatenate([instead, other], axis=-1)"),
        ("frame.py", HISTORY, "w"),
        ("frame.py", HISTORY, "np.abs(w)"),
    ],
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
    for change in PLANTS[constant.name]:
        message, worst = judged(load("planted", [change]), constant)
        assert worst >= BOUNDS, (change[2], message, worst)


def test_a_failure_names_the_constant():
    judge = Judge(load("planted", [PLANTS["beginning of the depth buffer"][0]]), shrink=True)
    with pytest.raises(DepartureError, match=r"; the case is made for beginning of the depth buffer \(10\)"):
        test_occlusion_warp.test_constants_are_those_of_the_specification(judge)


@pytest.mark.parametrize("name", ["orders", "fma", "flush", "winograd_4", "half"])
def test_right_ports_pass(name):
    for constant in CONSTANTS:
        assert judged(right_ports.port(name), constant)[0] == "", constant.name


def test_the_table_is_complete():
    """Every constant has a plant, and every number of the reference's stages but 1/2, the place between two pixels, is in one."""
    assert PLANTS.keys() == {constant.name for constant in CONSTANTS}
    planted = {float(number) for changes in PLANTS.values() for _, old, _ in changes for number in re.findall(r"\d[\d.e-]*", old)}
    for stage in (*STAGES, "constants", "resample", "conv", "sample"):
        for node in ast.walk(ast.parse((ROOT / "stss_ref" / f"{stage}.py").read_text())):
            if isinstance(node, ast.Constant) and type(node.value) is float and node.value != 0.5:
                assert node.value in planted, (stage, node.value)


def test_the_page_has_the_table():
    page = (ROOT / "docs" / "conformance.md").read_text()
    for constant in CONSTANTS:
        assert f"| {constant.name} | {constant.value} | `{constant.stage}` |" in page
