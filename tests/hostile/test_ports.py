"""Hostile job folders and ports: they touch nothing outside, do not hang, do not pass if wrong, and leave no process."""

import json
import os
import sys
import tracemalloc
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from conformance.cases import stage_inputs as drawn
from conformance.judging.findings import DepartureError, WrongError
from conformance.judging.judge import Judge, agreement
from conformance.protocol.job_folder import write_job
from conformance.protocol.port import Case, PortError
from conformance.protocol.program_port import FolderPort, smallest_case
from conformance.protocol.stages import STAGES
from conformance.report.failures import replay
from conformance.report.report import write_json
from conformance.suite.run_suite import run_suite
from stss.cli.main import stss as command
from stss.port import ReferencePort
from stss_ground.errors import InputError
from stss_ref.arrays import ArrayError
from stss_ref.weights import random as random_weights
from tests.hostile.cases import call, refused, stss
from tests.tiers import every, thorough


@pytest.fixture
def job(tmp_path):
    """A job of one case of stage warp, and what lies outside of it."""
    write_job(tmp_path / "job", [smallest_case("warp")])
    outside = tmp_path / "outside"
    outside.mkdir()
    np.save(outside / "color.npy", np.zeros((8, 8, 3), np.float32))
    np.save(outside / "warped.npy", np.zeros((8, 8, 3), np.float32))
    (outside / "stage").write_text("warp\n")
    (outside / "unsupported").write_text("mine")
    return tmp_path / "job"


def everything(folder):
    """Names, kinds, bytes and times of all that lies in a folder."""
    return {
        path.relative_to(folder): (path.lstat().st_mode, path.lstat().st_mtime_ns, path.is_file() and path.read_bytes())
        for path in folder.rglob("*")
    }


# A job that is no tree of real files: what lies there, what is put in its place.

LINKS = {
    "0000": "outside", "0000/in": "outside", "0000/stage": "outside/stage", "0000/in/color.npy": "outside/color.npy",
    "0000/out": "outside", "0000/unsupported": "outside/unsupported", "0000/out/warped.npy": "outside/warped.npy",
}  # fmt: skip


@pytest.mark.parametrize("place", LINKS)
def test_a_link_in_a_job_is_refused(job, place):
    """Nothing outside is read, written or removed."""
    path, target = job / place, job.parent / LINKS[place]
    path.parent.mkdir(exist_ok=True)
    if path.is_dir():
        path.rename(job / "aside")
    elif path.exists():
        path.unlink()
    path.symlink_to(target)
    before = everything(job.parent)
    refused(call("port", job), path, "a link; a job is a tree of real files")
    assert everything(job.parent) == before


# Ports that are programs.

PROGRAM = """
import os, pathlib, shutil, subprocess, sys, time
import numpy as np

job = pathlib.Path(sys.argv[1])
case, out = job / "0000", job / "0000" / "out"
outside = job.parent.parent / "outside"

def right():
    out.mkdir()
    np.save(out / "warped.npy", np.load(case / "in" / "color.npy"))
    np.save(out / "inside.npy", np.ones((8, 8), np.uint8))

"""


@pytest.fixture
def program(tmp_path, monkeypatch):
    """A port of stage warp that is ``PROGRAM`` and some lines, with its jobs in a folder of their own."""
    (tmp_path / "jobs").mkdir()
    (tmp_path / "outside").mkdir()
    np.save(tmp_path / "outside" / "warped.npy", np.zeros((8, 8, 3), np.float32))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "jobs"))

    def make(lines, timeout=30.0):
        (tmp_path / "program.py").write_text(PROGRAM + lines)
        return FolderPort([sys.executable, str(tmp_path / "program.py")], timeout)

    return make


CHILD = "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)', sys.argv[1]])"
LINKED = "(out / 'warped.npy').unlink(); (out / 'warped.npy').symlink_to('/dev/zero')"
FAULTS = {
    "removes its job": ("right(); shutil.rmtree(job)", "no such folder"),
    "removes a case": ("shutil.rmtree(case)", "color.npy: removed; a program leaves its inputs as they are"),
    "writes to its inputs": (
        "right(); np.load(case / 'in' / 'color.npy', mmap_mode='r+')[0] = 0",
        "color.npy: changed; a program leaves its inputs as they are",
    ),
    "answers with a link": (f"right(); {LINKED}", "npy: a link"),
    "talks without end": ("while True: os.write(2, b'x' * 2**20)", "stopped: more than 64 MiB"),
    "fails": ("sys.exit(3)", "ended with status 3"),
    "crashes": ("import signal; os.kill(os.getpid(), signal.SIGSEGV)", "ended by SIGSEGV"),
    "leaves a mask out": ("right(); (out / 'inside.npy').unlink()", "inside.npy: missing; out holds warped.npy"),
    "spells a name otherwise": (
        "right(); (out / 'inside.npy').rename(out / 'Inside.npy')",
        "inside.npy: missing; out holds Inside.npy, warped.npy",
    ),
    "makes no folder": ("shutil.rmtree(out, ignore_errors=True)", "warped.npy: missing; there is no folder out"),
    "turns an image": (
        "right(); np.save(out / 'warped.npy', np.zeros((3, 8, 8), 'f4'))",
        "expected shape (8, 8, 3), got (3, 8, 8)",
    ),
    "answers in float64": ("right(); np.save(out / 'warped.npy', np.zeros((8, 8, 3)))", "expected dtype float32, got float64"),
    "masks with 255": (
        "right(); np.save(out / 'inside.npy', np.full((8, 8), 255, 'u1'))",
        "inside.npy: expected 0 and 1, got 255",
    ),
    "answers with a pickle": ("right(); np.save(out / 'warped.npy', np.zeros(3, object))", "warped.npy: not a .npy file"),
    "answers and refuses": ("right(); (case / 'unsupported').touch()", "unsupported"),
    "writes a terminal's orders": ("sys.stderr.write('\\x1b[2J!'); sys.exit(1)", "\\x1b[2J!"),
}


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize("fault", every(2, FAULTS))
def test_a_faulty_program_says_what_it_did(program, tmp_path, fault):
    """One error without a traceback; nothing outside its job is touched, and no process of it is left."""
    lines, words = FAULTS[fault]
    before = everything(tmp_path / "outside")
    with pytest.raises(PortError) as error:
        program(lines).run("warp", smallest_case("warp").inputs)
    assert words in str(error.value)
    assert "root:" not in str(error.value)
    assert all(line.isprintable() for line in str(error.value).splitlines())
    assert everything(tmp_path / "outside") == before
    assert not processes_of(tmp_path)
    for job in (tmp_path / "jobs").iterdir():
        assert str(job) in str(error.value)
        assert (job / "stderr.txt").is_file()


def processes_of(folder):
    """Those that were started for a job in this folder, and their children."""
    sessions = set()
    for path in Path("/proc").glob("[0-9]*"):
        try:
            words = (path / "cmdline").read_bytes(), (path / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if words[1][0] not in "ZX" and os.fsencode(folder) in words[0]:
            sessions.add(path.name)
    return sessions


@pytest.mark.skipif(sys.platform != "linux", reason="what leaves its process group ends on Linux alone")
@pytest.mark.parametrize("stays", [False, thorough(True)])
def test_what_a_program_leaves_ends_with_it(program, tmp_path, stays):
    """A child, and one with a session and an environment of its own whose parent has ended; after a right answer, and after its time."""
    away = CHILD.replace("[1]])", "[1]], start_new_session=True, env={})")
    child = f"{CHILD}; subprocess.run([sys.executable, '-c', \"import subprocess, sys; {away}\", sys.argv[1]])"
    if stays:
        with pytest.raises(PortError, match="stopped after 3 s"):
            program(f"{child}; time.sleep(600)", 3).run("warp", smallest_case("warp").inputs)
    else:
        assert program(f"right(); {child}").run("warp", smallest_case("warp").inputs).keys() == {"warped", "inside"}
    assert not processes_of(tmp_path)


def test_a_right_program_leaves_nothing_behind(program, tmp_path):
    """Files beside the named outputs, and noise, do no harm; NaN is left to the judge."""
    port = program(
        "right(); print('hello'); print('starting', file=sys.stderr); (out / 'notes').touch()\n"
        "np.save(out / 'debug.npy', np.ones(3, object)); np.save(out / 'warped.npy', np.full((8, 8, 3), np.nan, 'f4'))"
    )
    assert np.isnan(port.run("warp", smallest_case("warp").inputs)["warped"]).all()
    assert port.stderr == "starting"
    assert not list((tmp_path / "jobs").iterdir())


def test_the_second_of_two_cases_is_named(program):
    with pytest.raises(PortError, match=r"0001.out.warped.npy: missing"):
        program("right()").run_many([smallest_case("warp")] * 2)


def test_a_program_that_cannot_be_started(tmp_path):
    plain = tmp_path / "plain"
    plain.write_text("not a program")
    for path, word in ((tmp_path / "nowhere", "No such file"), (plain, "Permission denied"), (tmp_path, "Permission denied")):
        with pytest.raises(PortError, match=rf"{path}.*{word}"):
            FolderPort([str(path)], 5).run("warp", smallest_case("warp").inputs)


def test_wrong_inputs_and_no_cases_start_nothing():
    port, inputs = FolderPort(["/nowhere/port"], 1), smallest_case("warp").inputs
    for wrong in ({}, {**inputs, "more": np.zeros(1)}, {name: a.astype("f8") for name, a in inputs.items()}):
        with pytest.raises(ArrayError):
            port.run("warp", wrong)
    with pytest.raises(ArrayError, match="stage"):
        port.run("wrap", inputs)
    assert port.run_many([]) == []


# Nothing judged is no success.

FEW = """
from stss.port import ReferencePort

class Few(ReferencePort):
    def stages(self):
        return frozenset({"rrm"})

class None_(ReferencePort):
    def stages(self):
        return frozenset()
"""


@pytest.mark.parametrize(
    ("port", "stages"), [("None_", None), ("Few", "warp,holes"), ("Few", "sequence")], ids=["no stage", "others", "sequence"]
)
def test_nothing_judged_is_a_failure(tmp_path, monkeypatch, port, stages):
    """Its own words, status 1, and the same in JSON, JUnit and on the page."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "few_ports", raising=False)
    (tmp_path / "few_ports.py").write_text(FEW)
    files = ["--json", "found.json", "--junit", "junit.xml", "--report", "page.html"]
    some = ["--stages", stages] if stages else []
    outcome = CliRunner().invoke(command, ["conform", "--port", f"few_ports:{port}", *some, *files])
    assert outcome.exit_code == 1
    message = "nothing was judged: the port has none of the stages asked for"
    assert message in outcome.output
    data = json.loads(Path("found.json").read_text())
    assert not data["passed"]
    assert not data["judged"]
    assert message in data["tests"][-1]["message"]
    suite = ElementTree.parse("junit.xml").getroot().find("testsuite[@name='suite']")
    assert suite.get("failures") == "1"
    assert message in suite.find(".//failure").text
    assert "was not judged" in Path("page.html").read_text()


ODD = """
from stss.port import ReferencePort
class Port(ReferencePort):
    name = "odd \\ud800"
    def run(self, stage, inputs, weights=None):
        raise ValueError("no \\ud800 good")
"""


def test_half_a_character_in_a_ports_error_is_an_escape(tmp_path, monkeypatch):
    """In what is printed, and in every file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "odd_port", raising=False)
    (tmp_path / "odd_port.py").write_text(ODD)
    files = ["--json", "found.json", "--junit", "junit.xml", "--report", "page.html"]
    outcome = CliRunner().invoke(command, ["conform", "--port", "odd_port:Port", "--stages", "rrm", "--fail-fast", *files])
    assert (outcome.exit_code, type(outcome.exception)) == (1, SystemExit), outcome.output
    assert "no \\ud800 good" in outcome.output
    assert "no \\ud800 good" in Path("junit.xml").read_text()
    assert "no \\ud800 good" in Path("page.html").read_text()
    assert any("no \\ud800 good" in path.read_text() for path in Path("conform-failures").glob("*/README.txt"))


@pytest.mark.skipif(sys.platform == "win32", reason="folders without the right to write")
def test_a_failure_that_cannot_be_kept_is_told_all_the_same(tmp_path, monkeypatch):
    """In a folder that cannot be written to: the port's failure, a line why it is not kept, status 1."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.MonkeyPatch.context() as context:
        context.setattr(ReferencePort, "run", lambda *_: {})
        words = ["conform", "--port", "stss.port:ReferencePort", "--stages", "rrm", "--failures", "file/x"]
        outcome = CliRunner().invoke(command, words)
    assert (outcome.exit_code, type(outcome.exception)) == (1, SystemExit), outcome.output
    assert "not kept: file/x: the folder cannot be made" in outcome.output
    assert "--failures takes another folder" in outcome.output


def test_a_report_that_cannot_be_written_is_one_line(tmp_path, monkeypatch):
    """In the middle of a run: pytest would call it an internal error."""

    def full(path, data):
        raise InputError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr("conformance.report.report.write_named", full)
    with pytest.raises(InputError, match="No space left"):
        run_suite(Judge(ReferencePort()), ["rrm"], on_result=lambda result, total: write_json(tmp_path / "x.json", {}))


@pytest.mark.parametrize("version", [1, 2, 3])
def test_an_array_whose_header_is_as_long_as_its_file_is_not_read(job, version):
    """A file of 4 GiB that takes no place on the disk."""
    length = 0xFFFF if version == 1 else 0xFFFFFF00
    path = job / "0000" / "in" / "color.npy"
    with path.open("wb") as file:
        file.write(b"\x93NUMPY" + bytes([version, 0]) + length.to_bytes(2 if version == 1 else 4, "little"))
        file.truncate(length + 12)
    tracemalloc.start()
    try:
        refused(call("port", job), "color.npy: not a .npy file of numbers: its header claims")
        assert tracemalloc.get_traced_memory()[1] < 1 << 28
    finally:
        tracemalloc.stop()


def test_no_stages_are_no_run():
    """Pytest without files would run those of the user."""
    for stages in ([], ["wrap"]):
        with pytest.raises(ValueError, match="stages: expected some of motion_chain"):
            run_suite(Judge(ReferencePort()), stages)


# One wrong number among right ones.

STRATEGIES = {
    "motion_chain": drawn.chain_inputs(6), "warp": drawn.warp_inputs(6), "holes": drawn.holes_inputs(6),
    "occlusion_warp": drawn.occlusion_inputs(6), "reshade": drawn.reshade_inputs(6), "rrm": drawn.rrm_inputs(6),
    "frame": drawn.frame_inputs(), "accumulate": drawn.accumulate_inputs(4),
    **{stage: drawn.network_inputs(stage) for stage in ("history", "encoder", "erm", "decoder", "network")},
}  # fmt: skip


def strategy_of(stage):
    assert stage in STRATEGIES, f"{stage}: no strategy; expected a row of STRATEGIES in tests/hostile/test_ports.py"
    return STRATEGIES[stage]


def weights_of(stage):
    return random_weights(0) if STAGES[stage].weights else None


def agrees(judge, stage, inputs):
    judge.check(agreement, Case(stage, inputs, weights_of(stage)))


class PlantedPort(ReferencePort):
    """The reference, but for what ``change`` does to its outputs."""

    def __init__(self, change, dtype="float32"):
        self.change, self.dtype = change, dtype

    def run(self, stage, inputs, weights=None):
        outputs = super().run(stage, inputs, weights)
        self.change(outputs)
        return outputs


@pytest.mark.parametrize(("stage", "output"), [(stage, name) for stage, row in STAGES.items() for name in row.outputs])
def test_one_wrong_number_fails(stage, output):
    """NaN or Inf at any place of a float output, unless the answer is lost as a whole; a wrong pixel of a mask, unless rounding decides."""
    is_mask = STAGES[stage].outputs[output].kind == "uint8"

    @settings(max_examples=6 if STAGES[stage].weights else 25, database=None)
    @given(strategy_of(stage), st.data())
    def one(inputs, data):
        def plant(outputs):
            array = outputs[output]
            places = np.argwhere(np.isfinite(array).all(axis=-1, keepdims=True) | np.zeros(array.shape, bool))
            if len(places):
                plants.append(tuple(places[data.draw(st.integers(0, len(places) - 1))]))
                array[plants[-1]] = 1 - array[plants[-1]] if is_mask else data.draw(st.sampled_from([np.nan, np.inf, -np.inf]))

        plants, names_seen, judge = [], "", Judge(PlantedPort(plant))
        try:
            agrees(judge, stage, inputs)
        except DepartureError as error:
            names_seen = str(error)
        assert bool(plants) == (f"{stage}.{output}: " in names_seen) or (is_mask and judge.record.undecided)

    one()


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_an_answer_that_is_not_judged_is_a_number_all_the_same(monkeypatch, number):
    """Where rounding decides on a whole frame, it does not decide whether the frame is one."""
    monkeypatch.setattr("conformance.judging.judge.expect", lambda *_: {})
    inputs, judge = smallest_case("frame").inputs, Judge(ReferencePort())
    agrees(judge, "frame", inputs)
    assert (judge.record.unjudged, judge.record.worst) == (1, {})
    with pytest.raises(DepartureError, match=r"frame.image: wrong at \[3, 4, 1\]"):
        agrees(Judge(PlantedPort(lambda outputs: outputs["image"].__setitem__((3, 4, 1), number))), "frame", inputs)


@pytest.mark.parametrize("stage", STAGES)
def test_zeros_of_either_sign_and_lost_small_numbers_pass(stage):
    """Freedoms of a port in docs/conformance.md."""

    def change(outputs):
        for array in outputs.values():
            if array.dtype.kind == "f":
                array[np.abs(array) < np.finfo(np.float32).tiny] = -0.0

    @settings(max_examples=3 if STAGES[stage].weights else 15, database=None)
    @given(strategy_of(stage))
    def one(inputs):
        agrees(Judge(PlantedPort(change)), stage, inputs)

    one()


def test_a_port_that_writes_into_what_it_was_given_is_found_out():
    """Inputs and weights are its own copies: what it does to them is not what it is judged by."""

    class Careless(ReferencePort):
        def run(self, stage, inputs, weights=None):
            for array in [*inputs.values(), *(weights or {}).values()]:
                array[...] = 0
            return super().run(stage, inputs, weights)

    rectangle = smallest_case("rrm").inputs["rectangle"]
    valid, history = np.ones((8, 8), np.uint8), np.ones((3, 8, 8, 4), np.float32)
    for stage, inputs in (("rrm", {"valid": valid, "rectangle": rectangle}), ("history", {"history": history})):
        with pytest.raises(DepartureError):
            agrees(Judge(Careless()), stage, inputs)


def test_a_port_that_answers_in_one_buffer_is_found_out():
    """The answer before is kept: two that differ are told apart though the port has them in one place."""

    class Reusing(ReferencePort):
        buffer = np.zeros((8, 8), np.uint8)

        def run(self, stage, inputs, weights=None):
            self.buffer[...] ^= 1
            return {"valid": self.buffer}

    judge = Judge(Reusing())
    first, second = (judge.run("rrm", smallest_case("rrm").inputs)["valid"] for _ in range(2))
    with pytest.raises(WrongError):
        judge.same("rrm.valid", second, first)


class NoWordsError(Exception):
    def __str__(self):
        raise RuntimeError


@pytest.mark.parametrize(
    ("raised", "words"),
    [
        (SystemExit(3), "SystemExit: 3"),
        (GeneratorExit("g"), "GeneratorExit: g"),
        (NoWordsError(), "NoWordsError, whose message cannot be shown"),
        ([1.0], "warped: expected a NumPy array, found list"),
        (None, "expected a dictionary of arrays, found NoneType"),
    ],
    ids=["exit", "base", "no words", "list", "None"],
)
def test_whatever_an_object_raises_or_answers_is_a_failure_with_its_case(raised, words):
    class Odd(ReferencePort):
        def run(self, stage, inputs, weights=None):
            if isinstance(raised, BaseException):
                raise raised
            return raised and dict.fromkeys(("warped", "inside"), raised)

    judge = Judge(Odd())
    with pytest.raises(DepartureError):
        agrees(judge, "warp", smallest_case("warp").inputs)
    assert words in str(judge.failure().finding)


def test_what_a_port_sets_for_numpys_errors_ends_with_its_answer():
    class Strict(ReferencePort):
        def run(self, stage, inputs, weights=None):
            np.seterr(all="raise")
            with np.errstate(all="ignore"):
                return super().run(stage, inputs, weights)

    before = np.geterr()
    agrees(Judge(Strict()), "warp", smallest_case("warp").inputs)
    assert np.geterr() == before


# Replay


def test_a_replay_is_judged_or_says_so(tmp_path):
    """A job of one case is held against the reference; a folder that was tampered with is refused."""
    folder = tmp_path / "kept"
    write_job(folder, [Case("warp", {name: array + 0.5 for name, array in smallest_case("warp").inputs.items()})])
    assert replay(ReferencePort(), folder).worst == {"warp.warped": 0, "warp.inside": 0}
    wrong = PlantedPort(lambda outputs: outputs["warped"].fill(np.nan))
    assert "warp.warped: error / bound inf" in replay(wrong, folder).failure.finding.message
    (folder / "property").mkdir()
    for drawn_text in ("", '{"test": 3, "drawn": 1}', '{"test": "warp.agrees_with_the_reference", "drawn": {"array": "../x"}}',
                       '{"test": "os.system", "drawn": {"dict": {"a": 1}}}'):  # fmt: skip
        (folder / "property" / "property.json").write_text(drawn_text)
        with pytest.raises(InputError, match=r"damaged|expected the folder of one failure"):
            replay(wrong, folder)


@pytest.mark.thorough
def test_native_code_that_ends_the_judge_names_its_line_and_as_a_program_its_case(tmp_path):
    """A Python port runs in the judge's process, unless `stss port` has it."""
    lines = [
        "import os",
        "from stss.port import ReferencePort",
        "class Port(ReferencePort):",
        "    def run(self, stage, inputs, weights=None):",
        "        return os.abort() if inputs['color'].shape[1] % 2 else super().run(stage, inputs, weights)",
    ]
    (tmp_path / "native.py").write_text("\n".join(lines))
    outcome = stss("conform", "--port", "native:Port", "--stages", "warp", cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)})
    assert outcome.returncode < 0
    assert f'native.py", line {len(lines)} in run' in outcome.stderr
    program = f"{sys.executable} -m stss port --port native:Port"
    outcome = stss(
        "conform", "--exec", program, "--stages", "warp", "--fail-fast", cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)}
    )
    assert outcome.returncode == 1
    assert "ended by SIGABRT" in outcome.stdout + outcome.stderr
    assert (tmp_path / "conform-failures").is_dir()
