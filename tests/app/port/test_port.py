"""``stss port``: the project's backends as programs that get a job folder."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conformance.protocol import job_folder as jobs
from conformance.protocol.port import Case, PortError
from conformance.protocol.program_port import FolderPort, smallest_case
from conformance.protocol.stages import STAGES, reference
from stss import port as ports
from stss_ground.errors import InputError
from stss_ref.weights import Weights
from tests.hostile.cases import call
from tests.meta.samples import samples

DOCS = Path(__file__).parents[3] / "docs" / "ports.md"


def command(backend):
    """``stss port`` without the command line."""
    code = f"import pathlib, sys, stss.port; stss.port.run_job(pathlib.Path(sys.argv[1]), {backend!r})"
    return [sys.executable, "-c", code]


@pytest.fixture
def job(tmp_path):
    """Write cases into a job folder; without any, the smallest one of a stage."""

    def write(*cases, stage="warp"):
        jobs.write_job(tmp_path / "job", cases or [smallest_case(stage)])
        return tmp_path / "job"

    return write


def bits(arrays):
    return {name: (array.dtype, array.shape, array.tobytes()) for name, array in arrays.items()}


def test_the_reference_as_a_program_has_the_bits_of_the_reference():
    """Every stage, at one start of the program."""
    cases = [case for stage in STAGES for case in samples(stage)[:6]]
    last = smallest_case("frame")
    cases.append(replace(last, weights=Weights(last.weights, "detail")))
    results = FolderPort(command("ref"), timeout=120).run_many(cases)
    for case, got in zip(cases, results, strict=True):
        assert bits(got) == bits(reference(case.stage, case.inputs, case.weights)), case.stage


def test_files_are_plain(job):
    """Version 1.0, little-endian, C order, for arrays of any layout: this is all that a porter's reader must know."""
    case = smallest_case("frame")
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


def test_headers_of_inputs_differ_in_length(job):
    """A port that takes 128 bytes for every header is wrong in some."""
    folder = job(
        *(Case("rrm", {"valid": np.ones((1, w), np.uint8), "rectangle": np.array([0, 0, 1, 1], np.int32)}) for w in range(1, 5))
    )
    lengths = set()
    for path in folder.glob("*/in/valid.npy"):
        data = path.read_bytes()
        begin = 10 + int.from_bytes(data[8:10], "little")
        lengths.add(begin)
        assert begin % 64 == 0
        assert len(data) - begin == np.load(path).size
    assert lengths == {128, 192, 384}


def test_results_of_two_runs_never_stand_side_by_side(job):
    folder = job(smallest_case("warp"), smallest_case("warp"))
    ports.run_job(folder, "ref")
    (folder / "0000" / "stage").write_text("later_stage\n")
    ports.run_job(folder, "ref")
    assert (folder / "0001" / "out" / "warped.npy").exists()
    assert (folder / "0000" / "unsupported").read_bytes() == b""
    assert not list((folder / "0000" / "out").iterdir())
    (folder / "0000" / "stage").write_text("warp")
    ports.run_job(folder, "ref")
    assert not (folder / "0000" / "unsupported").exists()
    assert sorted(path.name for path in (folder / "0000" / "out").iterdir()) == ["inside.npy", "warped.npy"]


def saved(array):
    """For `MALFORMED`: the array in place of the file."""
    return lambda path: np.save(path, array)


def rewritten(change):
    return lambda path: path.write_bytes(change(path.read_bytes()))


WEIGHTS = "0000/in/weights.safetensors"
MALFORMED = [
    # stage, change of its job, message
    ("warp", "0000/in/motion.npy", saved(np.zeros((8, 8, 2))), "expected dtype float32, got float64"),
    ("warp", "0000/in/motion.npy", saved(np.zeros((0, 8, 2), "f4")), "expected shape (8, 8, 2), got (0, 8, 2)"),
    ("rrm", "0000/in/valid.npy", saved(np.full((8, 8), 255, "u1")), "expected 0 and 1, got 255, first at index (0, 0)"),
    ("warp", "0000/in/colour.npy", Path.touch, "not an input of stage warp (color, motion)"),
    ("warp", "0000/in/motion.npy", Path.unlink, "missing"),
    ("warp", "0000/in", lambda path: path.rename(path.with_name("into")), "no such folder"),
    ("warp", "0000/stage", rewritten(lambda _: b"warp\nholes\n"), "one line"),
    ("warp", "0000/stage", rewritten(lambda _: b"\xff\xfe\0"), "one line"),
    ("warp", "0000/stage", Path.unlink, "missing"),
    ("warp", "0000", lambda path: path.rename(path.parents[1] / "away"), "no case"),
    ("history", WEIGHTS, rewritten(lambda data: data[:-4]), ""),
    ("history", WEIGHTS, rewritten(lambda data: data.replace(b"outc.bias", b"outc.bjas")), "outc.bias"),
    ("history", WEIGHTS, lambda path: os.truncate(path, 2**30), "larger"),
    ("history", WEIGHTS, Path.unlink, ""),
]


@pytest.mark.parametrize(("stage", "place", "change", "words"), MALFORMED)
def test_what_is_wrong_with_a_job_is_named(job, stage, place, change, words):
    folder = job(stage=stage)
    change(folder / place)
    with pytest.raises(InputError) as error:
        ports.run_job(folder, "ref")
    message = str(error.value)
    assert len(message.splitlines()) == 1
    assert str(folder if place == "0000" else folder / place) in message
    assert words in message


def test_a_height_that_a_stage_does_not_take_is_named(job):
    folder = job(stage="encoder")
    for name, channels in (("color", (6,)), ("gbuffer", (9,)), ("mask", ())):
        np.save(folder / "0000" / "in" / f"{name}.npy", np.zeros((9, 8, *channels), np.float32))
    with pytest.raises(InputError, match=r"color.npy: expected H to be a multiple of 8, got 9"):
        ports.run_job(folder, "ref")


@pytest.mark.thorough
def test_the_opencl_backend_is_a_port():
    """Small cases of all it has, on whatever device there is: names, shapes and dtypes are the table's."""
    port = FolderPort(command("cl"), timeout=300)
    try:
        assert port.stages() <= frozenset(STAGES)
    except PortError as error:
        if "no OpenCL device" in str(error):
            pytest.skip("no OpenCL device")
        raise


def test_the_command(job):
    folder = job()
    assert call("port", "--backend", "ref", folder).returncode == 0
    assert (folder / "0000" / "out" / "inside.npy").exists()
    (folder / "0000" / "in" / "color.npy").unlink()
    result = call("port", "--backend", "ref", folder)
    assert result.returncode == 2
    assert result.stderr.splitlines() == [f"stss: {folder / '0000' / 'in' / 'color.npy'}: missing; in holds motion.npy"]


def test_the_page_can_be_followed(tmp_path):
    """Its Python runs as it stands there, one block after the other, with our program for the reader's."""
    blocks = re.findall(r"```python\n(.*?)```", DOCS.read_text(), flags=re.DOTALL)
    assert len(blocks) >= 2
    text = "\n".join(blocks).replace('["./my_port"]', json.dumps(command("ref")))
    subprocess.run([sys.executable, "-W", "error", "-c", text], cwd=tmp_path, check=True, timeout=60)
