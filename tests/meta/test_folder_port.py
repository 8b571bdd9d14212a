"""Programs that break the protocol, each in one way: the folder port says which."""

import sys
import time

import numpy as np
import pytest

from conformance.protocol import program_port
from conformance.protocol.port import Case, PortError
from conformance.protocol.program_port import FolderPort
from conformance.protocol.stages import reference
from stss_ref.arrays import ArrayError

PROGRAM = """
import os, pathlib, subprocess, sys, time
import numpy as np

case = pathlib.Path(sys.argv[1]) / "0000"
out = case / "out"
out.mkdir()
warped, inside = np.load(case / "in" / "color.npy"), np.ones((3, 4), np.uint8)
print("starting", file=sys.stderr, flush=True)

def write(**arrays):
    for name, array in arrays.items():
        np.save(out / f"{name}.npy", array)

"""


def warp_inputs():
    random = np.random.default_rng(4)
    return {"color": random.random((3, 4, 5)).astype(np.float32), "motion": np.zeros((3, 4, 2), np.float32)}


@pytest.fixture
def program(tmp_path, monkeypatch):
    """A port that is ``PROGRAM`` and some lines, with its jobs in a folder of their own."""
    (tmp_path / "jobs").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "jobs"))

    def make(lines, timeout=30.0):
        (tmp_path / "program.py").write_text(PROGRAM + lines)
        return FolderPort([sys.executable, str(tmp_path / "program.py")], timeout)

    return make


def kept(tmp_path):
    return list((tmp_path / "jobs").iterdir())


def test_a_right_program_leaves_nothing_behind(program, tmp_path):
    """Files beside the named outputs, and noise on stdout, do no harm."""
    port = program("print('hello'); write(warped=warped, inside=inside, debug=np.ones(3, object)); (out / 'notes').touch()")
    inputs = warp_inputs()
    got = port.run("warp", inputs)
    want = reference("warp", inputs)
    assert {name: array.tobytes() for name, array in got.items()} == {name: array.tobytes() for name, array in want.items()}
    assert port.stderr == "starting"
    assert not kept(tmp_path)


def test_jobs_lie_in_memory_where_there_is_room(monkeypatch, tmp_path):
    """Unless the user wants them elsewhere."""
    some = [Case("warp", warp_inputs())]
    monkeypatch.setattr(program_port, "MEMORY", tmp_path)
    monkeypatch.setattr("tempfile.tempdir", "/tmp")
    assert program_port.place_for(some) == tmp_path
    monkeypatch.setattr(program_port, "ROOM", 2**60)
    assert program_port.place_for(some) is None
    monkeypatch.setattr(program_port, "ROOM", 4)
    monkeypatch.setattr(program_port, "MEMORY", tmp_path / "nowhere")
    assert program_port.place_for(some) is None
    monkeypatch.setattr(program_port, "MEMORY", tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "jobs"))
    assert program_port.place_for(some) is None


def test_no_cases_start_nothing():
    assert FolderPort(["/nowhere/port"], 1).run_many([]) == []


def test_nan_is_left_to_be_judged(program):
    got = program("write(warped=warped * np.nan, inside=inside)").run("warp", warp_inputs())
    assert np.isnan(got["warped"]).all()


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("sys.exit(3)", ["ended with status 3", "starting"]),
        ("raise ValueError('no such device')", ["ended with status 1", "ValueError: no such device"]),
        ("sys.exit('x' * 9999 + ' the end')", ["ended with status 1", "x the end"]),
        ("sys.stderr.buffer.write(bytes([255, 254])); sys.exit(2)", ["ended with status 2"]),
        ("import signal; os.kill(os.getpid(), signal.SIGSEGV)", ["ended by SIGSEGV"]),
        ("", ["warped.npy: missing", "starting"]),
        ("write(warped=warped)", ["inside.npy: missing"]),
        ("write(warped=warped[:2], inside=inside)", ["warped.npy: expected shape (3, 4, 5), got (2, 4, 5)"]),
        ("write(warped=warped.transpose(2, 0, 1), inside=inside)", ["expected shape (3, 4, 5), got (5, 3, 4)"]),
        ("write(warped=warped[None], inside=inside)", ["expected shape (3, 4, 5), got (1, 3, 4, 5)"]),
        ("write(warped=warped.astype('f8'), inside=inside)", ["warped.npy: expected dtype float32, got float64"]),
        ("write(warped=warped.astype('f2'), inside=inside)", ["warped.npy: expected dtype float32, got float16"]),
        ("write(warped=warped, inside=inside == 1)", ["inside.npy: expected dtype uint8, got bool"]),
        ("write(warped=warped, inside=inside * 255)", ["inside.npy: expected 0 and 1, got 255"]),
        ("write(warped=warped.astype(object), inside=inside)", ["warped.npy: not a .npy file"]),
        ("write(inside=inside); (out / 'warped.npy').write_bytes(b'P6 4 3 255')", ["warped.npy: not a .npy file"]),
        ("write(inside=inside, warped=warped); os.truncate(out / 'warped.npy', 200)", ["warped.npy: not a .npy file"]),
        ("write(warped=warped, inside=inside); (case / 'unsupported').touch()", ["warped.npy", "unsupported"]),
    ],
)
def test_a_faulty_program_is_told_apart(program, tmp_path, lines, words):
    with pytest.raises(PortError) as caught:
        program(lines).run("warp", warp_inputs())
    message = str(caught.value)
    (job,) = kept(tmp_path)
    for word in [*words, str(job)]:
        assert word in message
    assert len(message) < 3000
    assert (job / "0000" / "in" / "color.npy").exists()
    assert (job / "stderr.txt").read_bytes().startswith(b"starting")


def test_a_program_that_hangs_is_stopped_with_what_it_started(program, tmp_path):
    late = tmp_path / "late"
    child = f"import time; time.sleep(6); open({str(late)!r}, 'w')"
    port = program(f"subprocess.Popen([sys.executable, '-c', {child!r}]); time.sleep(60)", timeout=4)
    start = time.monotonic()
    with pytest.raises(PortError, match=r"stopped after 4 s; its job is kept: .*\nstarting"):
        port.run("warp", warp_inputs())
    assert time.monotonic() - start < 20
    time.sleep(3)
    assert not late.exists()


def test_a_program_that_cannot_be_started(tmp_path, monkeypatch):
    (tmp_path / "jobs").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "jobs"))
    plain = tmp_path / "plain"
    plain.write_text("not a program")
    for command, word in ((tmp_path / "nowhere", "No such file"), (plain, "Permission denied"), (tmp_path, "Permission denied")):
        with pytest.raises(PortError, match=word) as caught:
            FolderPort([str(command)], 5).run("warp", warp_inputs())
        assert str(command) in str(caught.value)
    assert not kept(tmp_path)


def test_the_second_of_two_cases_is_named(program, tmp_path):
    cases = [Case("warp", warp_inputs()), Case("warp", warp_inputs())]
    with pytest.raises(PortError, match=r"0001.out.warped.npy: missing"):
        program("write(warped=warped, inside=inside)").run_many(cases)


def test_wrong_inputs_start_nothing(program, tmp_path):
    for inputs in ({}, {**warp_inputs(), "more": np.zeros(1)}, {name: a.astype("f8") for name, a in warp_inputs().items()}):
        with pytest.raises(ArrayError):
            program("").run("warp", inputs)
    with pytest.raises(ArrayError, match="stage"):
        program("").run("wrap", warp_inputs())
    assert not kept(tmp_path)
