"""``stss port``: the project's backends as programs that are handed a job folder."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conformance.protocol import job_folder as jobs
from conformance.protocol.port import Case, PortError
from conformance.protocol.program_port import FolderPort
from conformance.protocol.stages import STAGES, reference
from stss import port as ports
from stss_ground.errors import InputError
from stss_ref.weights import Weights
from stss_ref.weights import random as random_weights
from tests.hostile.cases import call

DOCS = Path(__file__).parents[2] / "docs" / "ports.md"
ANY_SIZE = ("motion_chain", "warp", "holes", "occlusion_warp", "rrm", "network", "frame")


def command(backend):
    """``stss port`` without the command line."""
    return [
        sys.executable,
        "-c",
        f"import pathlib, sys, stss.port; stss.port.run_job(pathlib.Path(sys.argv[1]), {backend!r})",
    ]


def random_case(stage, size, seed=0, k=5, channels=3):
    random = np.random.default_rng(seed)
    sizes = {"H": size[0], "W": size[1], "C": channels, "k": k}
    makers = {
        "float": lambda shape: random.random(shape).astype(np.float32),
        "uint8": lambda shape: random.integers(0, 2, shape, dtype=np.uint8),
        "int": lambda shape: np.zeros(shape, np.int32),
    }
    inputs = {name: makers[spec.kind](spec.shape(sizes)) for name, spec in STAGES[stage].inputs.items()}
    if "rectangle" in inputs:
        inputs["rectangle"][:] = (size[0] // 2, size[1] // 3, 1, 1)
    if "steps" in inputs:
        inputs["steps"][:] = (1, 3, 5)
    return Case(stage, inputs, random_weights(seed) if STAGES[stage].weights else None)


def warp_case():
    return random_case("warp", (3, 4))


@pytest.fixture
def job(tmp_path):
    """Write cases into a job folder."""

    def write(*cases):
        jobs.write_job(tmp_path / "job", cases or [warp_case()])
        return tmp_path / "job"

    return write


def refused(job, *words, backend="ref"):
    with pytest.raises(InputError) as caught:
        ports.run_job(job, backend)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    for word in words:
        assert str(word) in message


def bits(arrays):
    return {name: (array.dtype, array.shape, array.tobytes()) for name, array in arrays.items()}


# what a job carries


def test_the_reference_as_a_program_has_the_bits_of_the_reference():
    """Every stage, from 1 x 1 up where it takes any size, at one start of the program."""
    cases = [random_case(stage, size, seed) for stage in ANY_SIZE for seed, size in enumerate([(1, 1), (5, 3)])]
    cases += [random_case(stage, size, 9) for stage in STAGES if stage not in ANY_SIZE for size in [(8, 8), (16, 24)]]
    cases.append(random_case("motion_chain", (6, 5), k=1))
    cases.append(random_case("warp", (6, 5), channels=1))
    cases.append(random_case("warp", (3, 4)))
    cases[-1].inputs["motion"][0, 0] = np.nan, -np.inf
    last = random_case("frame", (8, 8), 9)
    cases.append(replace(last, weights=Weights(last.weights, "earlier")))

    results = FolderPort(command("ref"), timeout=120).run_many(cases)

    for case, got in zip(cases, results, strict=True):
        assert bits(got) == bits(reference(case.stage, case.inputs, case.weights)), case.stage
    assert bits(results[-1]) != bits(reference("frame", last.inputs, last.weights))


def test_files_are_plain(job):
    """Version 1.0, little-endian, C order, whatever the arrays were: what a porter's reader has to know."""
    case = random_case("frame", (8, 8))
    turned = {name: np.asfortranarray(a.astype(np.int64) if a.dtype == np.int32 else a) for name, a in case.inputs.items()}
    folder = job(Case("frame", turned, case.weights)) / "0000"
    assert (folder / "stage").read_text() == "frame\n"
    for name in case.inputs:
        data = (folder / "in" / f"{name}.npy").read_bytes()
        assert data.startswith(b"\x93NUMPY\x01\x00")
        kind = b"<i4" if name == "steps" else b"<f4"
        assert b"'descr': '" + kind + b"', 'fortran_order': False" in data[:128]
    assert bits(jobs.read_inputs(folder, "frame")) == bits(case.inputs)
    path = folder / "in" / "weights.safetensors"
    assert bits(jobs.read_weights(path.read_bytes(), path)) == bits(case.weights)


def test_results_of_two_runs_never_stand_side_by_side(job):
    folder = job()
    ports.run_job(folder, "ref")
    (folder / "0000" / "stage").write_text("later_stage\n")
    ports.run_job(folder, "ref")
    assert (folder / "0000" / "unsupported").exists()
    assert not list((folder / "0000" / "out").iterdir())
    (folder / "0000" / "stage").write_text("warp")
    ports.run_job(folder, "ref")
    assert not (folder / "0000" / "unsupported").exists()
    assert sorted(path.name for path in (folder / "0000" / "out").iterdir()) == ["inside.npy", "warped.npy"]


# malformed jobs


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((3, 4, 2), np.float64), ["dtype float32", "float64"]),
        (np.zeros((4, 3, 2), np.float32), ["shape (3, 4, 2)", "(4, 3, 2)"]),
        (np.zeros((0, 4, 2), np.float32), ["shape (3, 4, 2)", "(0, 4, 2)"]),
    ],
)
def test_an_array_that_does_not_fit_is_named(job, array, words):
    path = job() / "0000" / "in" / "motion.npy"
    np.save(path, array)
    refused(path.parents[2], path, *words)


def test_numbers_and_sizes_that_a_stage_does_not_take_are_named(job):
    path = job(random_case("rrm", (3, 4))) / "0000" / "in" / "valid.npy"
    np.save(path, np.full((3, 4), 255, np.uint8))
    refused(path.parents[2], path, "expected 0 and 1, got 255, first at index (0, 0)")
    shutil.rmtree(path.parents[2])
    path = job(random_case("encoder", (8, 8))) / "0000" / "in" / "color.npy"
    np.save(path, np.zeros((9, 8, 6), np.float32))
    refused(path.parents[2], path.with_name("gbuffer.npy"), "(9, 8, 9)")
    for name, channels in (("gbuffer", (9,)), ("mask", ())):
        np.save(path.with_name(f"{name}.npy"), np.zeros((9, 8, *channels), np.float32))
    refused(path.parents[2], path, "H to be a multiple of 8, got 9")


def test_missing_and_foreign_files_are_named(job, tmp_path):
    folder = job()
    case = folder / "0000"
    refused(tmp_path / "nowhere", "nowhere", "no such folder")
    refused(case, case, "no case")
    (case / "in" / "colour.npy").touch()
    refused(folder, case / "in" / "colour.npy", "not an input of stage warp (color, motion)")
    (case / "in" / "colour.npy").unlink()
    (case / "in" / "motion.npy").unlink()
    refused(folder, case / "in" / "motion.npy", "missing")
    (case / "in").rename(case / "into")
    refused(folder, case / "in", "no such folder")
    for text in (b"warp\nholes\n", b"\xff\xfe\0", b"../warp"):
        (case / "stage").write_bytes(text)
        refused(folder, case / "stage", "one line")
    (case / "stage").unlink()
    refused(folder, case / "stage", "missing")


def test_wrong_weights_are_named(job):
    path = job(random_case("history", (8, 8))) / "0000" / "in" / "weights.safetensors"
    whole = path.read_bytes()
    path.write_bytes(whole[:-4])
    refused(path.parents[2], path)
    path.write_bytes(whole.replace(b"outc.bias", b"outc.bjas"))
    refused(path.parents[2], path, "outc.bias")
    with path.open("wb") as file:
        file.truncate(2**30)
    refused(path.parents[2], path, "larger")
    path.unlink()
    refused(path.parents[2], path)


# backends


def test_an_unknown_stage_or_backend(job):
    folder = job(warp_case(), warp_case())
    (folder / "0000" / "stage").write_text("raytrace\n")
    ports.run_job(folder, "ref")
    assert (folder / "0000" / "unsupported").read_bytes() == b""
    assert (folder / "0001" / "out" / "warped.npy").exists()
    refused(folder, "backend", "ref, cl", "'cuda'", backend="cuda")


def test_the_opencl_backend_is_a_port():
    """Small cases of all it has, on whatever device there is: names, shapes and dtypes are the table's."""
    port = FolderPort(command("cl"), timeout=300)
    try:
        assert port.stages() <= frozenset(STAGES)
    except PortError as error:
        if "no OpenCL device" in str(error):
            pytest.skip("no OpenCL device")
        raise


# the command line and the page


def test_the_command(job):
    folder = job()

    assert call("port", "--backend", "ref", folder).returncode == 0
    assert (folder / "0000" / "out" / "inside.npy").exists()
    (folder / "0000" / "in" / "color.npy").unlink()
    result = call("port", "--backend", "ref", folder)
    assert result.returncode == 2
    assert result.stderr.splitlines() == [f"stss: {folder / '0000' / 'in' / 'color.npy'}: missing"]


def row(stage):
    """The stage's row of docs/ports.md."""

    def cell(specs):
        suffix = {"float": "", "uint8": " uint8", "int": " int32"}
        return "<br>".join(f"`{name}` {spec}{suffix[spec.kind]}" for name, spec in specs.items())

    return f"| `{stage.name}` | {cell(stage.inputs)} | {'yes' if stage.weights else ''} | {cell(stage.outputs)} |"


def test_the_page_has_the_table():
    rows = [line for line in DOCS.read_text().splitlines() if re.match(r"\| `\w", line) and line.count("|") == 5]
    assert rows == [row(stage) for stage in STAGES.values()]


def test_the_page_can_be_followed(tmp_path):
    """Its Python runs as it stands there, one block after the other, with our program for the reader's."""
    blocks = re.findall(r"```python\n(.*?)```", DOCS.read_text(), flags=re.DOTALL)
    assert len(blocks) >= 2
    text = "\n".join(blocks).replace('["./my_port"]', json.dumps(command("ref")))
    subprocess.run([sys.executable, "-W", "error", "-c", text], cwd=tmp_path, check=True, timeout=60)
