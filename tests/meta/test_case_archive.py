"""``stss conform --write-cases``: read as a stranger reads it, by the code of docs/ports.md, which imports only json and numpy."""

import hashlib
import importlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conformance.judging.judge import TIERS, Judge, Tier
from conformance.judging.search import DrawnCases
from conformance.mistakes import find
from conformance.protocol.job_folder import read_weights
from conformance.report.case_archive import write_cases
from stss.port import ReferencePort, run_job
from stss_ground.errors import InputError

PAGE = Path(__file__).parents[2] / "docs" / "ports.md"
FEW = Tier("few", 5, 2, 0)


def reader():
    """``departing(archive, case, output, got)``, as the page has it."""
    (block,) = [b for b in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S) if "def departing" in b]
    names = {}
    exec(block, names)
    return names["departing"]


def write_archive(folder, stages, tier=FEW, **arithmetic):
    write_cases(folder, stages, tier, **arithmetic)
    return json.loads((folder / "index.json").read_text())


def answers(archive, case, port):
    inputs = {name: np.load(archive / file) for name, file in case["inputs"].items()}
    weights = archive / case["weights"] if case["weights"] else None
    return port.run(case["stage"], inputs, read_weights(weights.read_bytes(), weights) if weights else None)


def share(archive, index, port):
    """The share of the cases in which each output departs."""
    departing, shares = reader(), {}
    for case in index["cases"]:
        got = answers(archive, case, port)
        for output in case["outputs"]:
            shares.setdefault(f"{case['stage']}.{output}", []).append(departing(archive, case, output, got[output]) > 0)
    return {name: float(np.mean(each)) for name, each in shares.items()}


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("archive") / "cases"
    return folder, write_archive(folder, ["motion_chain", "warp", "occlusion_warp", "rrm", "history"])


def test_the_reference_is_right(archive):
    shares = share(*archive, ReferencePort())
    assert len(shares) == 7
    assert not any(shares.values()), shares


@pytest.mark.parametrize(
    ("mistake", "output"),
    [
        ("warp_x_sign", "warp.warped"),
        ("rrm_filled", "rrm.valid"),
        ("motion_chain_x_sign", "motion_chain.motion"),
        ("history_newest_first", "history.feature"),
    ],
)
def test_a_mistake_is_wrong(archive, mistake, output):
    folder, index = archive
    stage = output.partition(".")[0]
    some = {**index, "cases": [case for case in index["cases"] if case["stage"] == stage]}
    assert share(folder, some, find(mistake).port())[output] > 0.2


def test_a_lost_number_is_wrong(archive):
    """NaN, a shape of its own, and a number just beyond its bound."""
    folder, index = archive
    departing = reader()
    case = next(case for case in index["cases"] if case["stage"] == "history")
    says = case["outputs"]["feature"]
    want, allowed = np.load(folder / says["expected"][0]), np.load(folder / says["allowed"])
    assert departing(folder, case, "feature", want) == 0
    assert departing(folder, case, "feature", want + 0.9 * allowed) == 0
    assert departing(folder, case, "feature", want + 1.1 * allowed) == 1
    assert departing(folder, case, "feature", want * np.nan) == 1
    assert departing(folder, case, "feature", want[:, :, :-1]) == 1


def test_it_is_a_job(archive, tmp_path):
    """A program is called with it as it is."""
    folder, index = archive
    few = tmp_path / "job"
    for case in index["cases"][:20]:
        for file in [f"{case['case']}/stage", *case["inputs"].values(), *([case["weights"]] if case["weights"] else [])]:
            (few / file).parent.mkdir(parents=True, exist_ok=True)
            (few / file).write_bytes((folder / file).read_bytes())
    run_job(few, "ref")
    for case in index["cases"][:20]:
        for output in case["outputs"]:
            assert reader()(folder, case, output, np.load(few / case["case"] / "out" / f"{output}.npy")) == 0


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    """And the checksums of the inputs agree with the index."""
    for name in ("a", "b"):
        index = write_archive(tmp_path / name, ["rrm", "history"], Tier("few", 4, 2, 1))
    sums = [(tmp_path / name / "SHA256SUMS").read_bytes() for name in ("a", "b")]
    assert sums[0] == sums[1]
    lines = sums[0].decode().splitlines()
    assert {line.split("  ")[1] for line in lines} == {
        path.relative_to(tmp_path / "a").as_posix() for path in (tmp_path / "a").rglob("*") if path.is_file()
    } - {"SHA256SUMS"}
    for line in lines:
        digest, file = line.split("  ")
        assert hashlib.sha256((tmp_path / "a" / file).read_bytes()).hexdigest() == digest
    inputs = "".join(f"{line}\n" for line in lines if re.search(r"  [0-9]+/(in/|stage$)", line))
    assert hashlib.sha256(inputs.encode()).hexdigest() == index["inputs_sha256"]


def test_weights_are_there_once(tmp_path):
    """Those of the large frames are the same."""
    folder, index = tmp_path / "cases", write_archive(tmp_path / "cases", ["history"], Tier("few", 1, 1, 2))
    files = [folder / case["weights"] for case in index["cases"] if case["weights"]]
    contents = {hashlib.sha256(path.read_bytes()).digest() for path in files}
    assert len({path.stat().st_ino for path in files}) == len(contents) < len(files)


def test_what_cannot_be_stored_is_listed(archive):
    tests = {test["id"]: test for test in archive[1]["tests"]}
    assert not tests["warp.channels_do_not_mix"]["stored"]
    assert not tests["history.sums_round_either_way"]["stored"]
    assert tests["warp.agrees_with_the_reference"]["cases"] > 0
    assert sum(test["cases"] for test in tests.values()) == len(archive[1]["cases"])


def test_exact_cases_allow_nothing(tmp_path):
    """Unless for Winograd, whose matrices have thirds."""
    for winograd in (False, True):
        folder = tmp_path / str(winograd)
        index = write_archive(folder, ["history"], Tier("few", 2, 1, 0), winograd=winograd)
        case = next(case for case in index["cases"] if case["test"] == "history.what_needs_no_rounding_is_exact")
        allowed = np.load(folder / case["outputs"]["feature"]["allowed"])
        assert (allowed.max() > 1e-30) == winograd


def test_it_is_whole_or_not_there(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(InputError, match="No space left"):
        write_archive(tmp_path / "cases", ["rrm"])
    assert not list(tmp_path.iterdir())


def test_modules_that_happen_to_be_imported_change_no_case(tmp_path, monkeypatch):
    """Hypothesis draws constants of modules that are not installed packages: a checkout's, a port's."""
    judge, numbers = Judge(ReferencePort(), TIERS["quick"], 0), DrawnCases(st.lists(st.integers() | st.floats(), max_size=8))
    before = repr(numbers.cases(judge))
    monkeypatch.syspath_prepend(tmp_path)
    for i in range(8):
        module = tmp_path / f"made_up_{i}.py"
        module.write_text("".join(f"X{j} = {1000 * i + j}, {i + j / 7}\n" for j in range(100)))
        monkeypatch.setitem(sys.modules, module.stem, importlib.import_module(module.stem))
    assert repr(numbers.cases(judge)) == before
    theirs = []

    @settings(max_examples=300, database=None)
    @given(st.integers())
    def draw(number):
        theirs.append(number)

    draw()
    assert {1000 * i + j for i in range(8) for j in range(100)} & {
        *theirs
    }  # where the judge does not draw, Hypothesis does as it likes
