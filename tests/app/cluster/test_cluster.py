"""`stss run --cluster`: the files of one process, even if workers die or hang."""

import contextlib
import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import BrokenExecutor, CancelledError, Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stss.cluster import run as module
from stss.cluster.chunk import Engine, Work, compute_chunk
from stss.cluster.run import run_on_cluster
from stss.cluster.workers import LocalWorkers, connect
from stss.frames.backends import open_backend
from stss.frames.compute_options import ComputeOptions
from stss.run.job import run
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss.sequence.sequence import Sequence
from stss.weights.file import BILINEAR, load
from stss_ground.errors import InputError
from stss_ground.machine import available_threads
from stss_ground.version import VERSION
from tests.app.conftest import PLAIN, files, frames_of
from tests.tiers import thorough

FRAMES = range(20)
SIZE = (8, 8)
PLAINLY = ComputeOptions()
RENDERED = frozenset(range(0, 20, 2))


@pytest.fixture
def frames(write_frames, monkeypatch):
    """A sequence that is cut into chunks of four frames where there are two workers."""
    monkeypatch.setattr(module, "MIN_CHUNK", 2)
    return open_sequence(write_frames(FRAMES, rendered=RENDERED, size=SIZE), "stss")


def on_cluster(sequence, out, where="threads", on_frame=lambda report: None, compute=PLAINLY, **options):
    return run_on_cluster(sequence, out, where, Engine(load(BILINEAR), "ref", compute), RunOptions(**options), on_frame)


def in_one_process(sequence, out, compute=PLAINLY, **options):
    weights = load(BILINEAR)
    return run(sequence, out, open_backend("ref", weights, compute), weights.label, RunOptions(**options))


def assert_as_in_one_process(sequence, out):
    in_one_process(sequence, out.with_name("one"))
    assert files(out) == files(out.with_name("one"))


class DiedError(Exception):
    pass


class Threads(ThreadPoolExecutor):
    """Two workers in this process. ``becomes`` gets the number of a chunk and its frames, and may answer in the worker's place."""

    def __init__(self, becomes):
        super().__init__(2)
        self._becomes, self._handed = becomes, 0

    def deaths(self):
        return (DiedError,)

    def count(self):
        return 2

    def start(self):
        return self

    def end(self, executor, *, hangs):
        pass

    def submit(self, function, *arguments):
        if function is compute_chunk:
            self._handed += 1
            if (answer := self._becomes(self._handed, arguments)) is not None:
                return answer
        return super().submit(function, *arguments)


@pytest.fixture
def threads(monkeypatch):
    """Takes the function ``becomes``; then the address "threads" leads to `Threads`."""

    def set_up(becomes=lambda handed, arguments: None):
        monkeypatch.setattr(module, "connect", lambda address: Threads(becomes))

    return set_up


def test_a_chunk_reads_five_frames_more_than_it_writes(frames, monkeypatch, tmp_path):
    reads, load_frame = [], Sequence.load
    monkeypatch.setattr(Sequence, "load", lambda self, n, **how: reads.append(n) or load_frame(self, n, **how))
    work = Work(VERSION, frames, RENDERED, tmp_path, RunOptions(), Engine(load(BILINEAR), "ref", ComputeOptions()))
    chunk = compute_chunk(work.part([9, 10, 11]), [9, 10, 11])
    assert reads == [4, 5, 6, 7, 8, 9, 10, 11]
    assert [list(of_frame) for _, of_frame in chunk.frames] == [
        ["holes/frame.0009.png", "frame.0009.exr"], ["frame.0010.exr"], ["holes/frame.0011.png", "frame.0011.exr"]
    ]  # fmt: skip
    assert not list(tmp_path.glob("*.exr"))
    other = compute_chunk(replace(work, version="0"), [1])
    assert f"a worker has stss {VERSION}; expected 0" in other.error


def test_a_chunk_has_the_first_frame_that_can_be_read(write_frames, tmp_path):
    """By it all processes decide alike whether the camera is solved."""
    folder = write_frames(FRAMES, rendered=RENDERED, size=SIZE)
    min(folder.iterdir()).write_bytes(b"")
    sequence = open_sequence(folder, "stss", keep_going=True)
    work = Work(VERSION, sequence, RENDERED, tmp_path, RunOptions(), Engine(load(BILINEAR), "ref", ComputeOptions()))
    assert work.part([15]).sequence.first is sequence.first


def test_resume_keeps_what_is_right_and_makes_the_rest(threads, frames, tmp_path):
    threads()
    out = tmp_path / "out"
    in_one_process(frames, out)
    whole = files(out)
    (out / "frame.0003.exr").unlink()
    (out / "frame.0017.exr").unlink()
    with pytest.raises(InputError, match="--resume"):
        on_cluster(frames, out)
    for numbers in ([3, 17], []):
        summary = on_cluster(frames, out, resume=True)
        assert [report.number for report in summary.frames if report.outcome == "done"] == numbers
        assert files(out) == whole


@pytest.mark.parametrize("resume", [False, True])
def test_the_writing_process_reads_a_frame_once_or_not_at_all(threads, frames, monkeypatch, tmp_path, resume):
    """An output depends on six frames, but each has one digest, for which only `--resume` asks. The first frame's header is read, too."""
    threads()
    reads, open_file = [], Path.open

    def noting(self, *arguments, **how):
        if self.parent == frames.path and threading.current_thread() is threading.main_thread():
            reads.append(self)
        return open_file(self, *arguments, **how)

    monkeypatch.setattr(Path, "open", noting)
    on_cluster(frames, tmp_path / "out", resume=resume)
    assert sorted(reads) == sorted([*(frames.images if resume else ()), frames.images[0]])


def test_overwrite_of_some_frames_leaves_the_others(threads, frames, tmp_path):
    threads()
    out = tmp_path / "out"
    in_one_process(frames, out)
    whole = files(out)
    with pytest.raises(InputError, match="transfer srgb, not none: --overwrite --frames 3:4 would mix two runs"):
        on_cluster(frames, out, overwrite=True, frames=(3, 4), transfer="none")
    (out / "frame.0003.exr").unlink()
    on_cluster(frames, out, overwrite=True, frames=(3, 4))
    assert files(out) == whole


def test_a_bad_frame_is_reported_as_in_one_process(threads, write_frames, tmp_path):
    def spoil(number, channels):
        if number in (13, 19):
            channels["R" if "R" in channels else "normal.X"][2, 3] = np.nan

    threads()
    sequence, lines = open_sequence(write_frames(FRAMES, rendered=RENDERED, size=SIZE, change=spoil), "stss"), []
    for work in (on_cluster, in_one_process):
        with pytest.raises(InputError) as error:
            work(sequence, tmp_path / f"out{len(lines)}")
        lines.append(str(error.value))
    assert lines[0] == lines[1]
    assert all((tmp_path / "out0" / f"frame.{n:04d}.exr").exists() for n in range(13))
    cluster, alone = (work(sequence, tmp_path / work.__name__, keep_going=True) for work in (on_cluster, in_one_process))
    assert cluster.frames == alone.frames
    assert files(tmp_path / "on_cluster") == files(tmp_path / "in_one_process")


@pytest.mark.parametrize("how", ["dies", thorough("hangs")])
def test_a_chunk_whose_worker_ends_is_computed_again(threads, frames, tmp_path, monkeypatch, how):
    def becomes(handed, arguments):
        if handed in (2, 3) or set(arguments[1]) & victims:
            future = Future()
            if how == "dies":
                future.set_exception(DiedError())
            return future
        return None

    if how == "hangs":
        monkeypatch.setattr(module, "MIN_TIMEOUT", 1.0)
        monkeypatch.setattr(module, "TIMEOUT_FACTOR", 5.0)
    victims = set()
    threads(becomes)
    on_cluster(frames, tmp_path / "many")
    assert_as_in_one_process(frames, tmp_path / "many")
    victims = {9}
    with pytest.raises(InputError, match=r"workers died or hung 4 times, frames 8 to 11; --resume goes on"):
        on_cluster(frames, tmp_path / "doomed")
    assert (tmp_path / "doomed" / "frame.0007.exr").exists()


def test_images_that_are_mixed_with_earlier_ones(threads, frames, tmp_path):
    """A chunk's first frames are mixed with images that its worker makes; a frame that is done is not made again."""
    threads()
    compute = ComputeOptions(accumulate=True)
    in_one_process(frames, tmp_path / "many", compute, frames=(5, 9))
    summary = on_cluster(frames, tmp_path / "many", compute=compute, resume=True)
    in_one_process(frames, tmp_path / "one", compute)
    assert frames_of(tmp_path / "many") == frames_of(tmp_path / "one")
    assert summary.count("kept") == 5
    in_one_process(frames, tmp_path / "plain")
    assert frames_of(tmp_path / "plain") != frames_of(tmp_path / "one")


def test_workers_of_different_kinds_are_refused(threads, frames, tmp_path):
    def becomes(handed, arguments):
        if handed != 2:
            return None
        future = Future()
        future.set_result(replace(compute_chunk(*arguments), backend="another"))
        return future

    threads(becomes)
    with pytest.raises(InputError, match=r"workers differ, .*: ref; another"):
        on_cluster(frames, tmp_path / "out")
    threads()
    on_cluster(frames, tmp_path / "out", resume=True)
    assert_as_in_one_process(frames, tmp_path / "out")


def sockets(process):
    ends = []
    for end in Path(f"/proc/{process}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed since it was listed
            ends += [end] * str(end.readlink()).startswith("socket:")
    return ends


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="no /proc")
def test_processes_here_have_no_socket_and_may_die(frames, tmp_path):
    """Without a socket no other user can reach them. One is killed when the first chunk has arrived."""
    pids, counts = [], []

    def on_frame(report):
        if not pids:
            children = multiprocessing.active_children()
            counts.extend(socket for child in children for socket in sockets(child.pid))
            pids.append(children[0].pid)
            os.kill(children[0].pid, signal.SIGKILL)

    on_cluster(frames, tmp_path / "many", "local:2", on_frame=on_frame)
    assert pids
    assert not counts
    assert not multiprocessing.active_children()
    assert_as_in_one_process(frames, tmp_path / "many")


def test_processes_share_the_cores():
    """Else each would decode and convert on as many threads as the machine has cores."""
    count = available_threads()
    workers = LocalWorkers(count)
    executor = workers.start()
    assert executor.submit(available_threads).result() == 1
    workers.end(executor, hangs=False)


@pytest.mark.skipif(os.name == "nt", reason="no signals")
def test_a_process_that_hangs_is_ended():
    workers = LocalWorkers(1)
    executor = workers.start()
    os.kill(executor.submit(os.getpid).result(), signal.SIGSTOP)
    future = executor.submit(os.getpid)
    workers.end(executor, hangs=True)
    assert not multiprocessing.active_children()
    with pytest.raises((BrokenExecutor, CancelledError)):
        future.result()


@pytest.mark.skipif(os.name == "nt", reason="no process groups")
@pytest.mark.parametrize("where", [[], thorough(["--cluster", "local:2"])])
def test_an_interrupt_is_one_line_that_says_how_to_go_on(frames, tmp_path, where):
    """It is sent to all processes, as a terminal does, when the first frames are there."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "stss", "run", frames.path, "-o", out, *PLAIN, "--profile", "stss"]
    with subprocess.Popen([*command, *where], stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        while process.poll() is None and not list(out.glob("frame.*")):
            time.sleep(0.005)
        os.killpg(process.pid, signal.SIGINT)
        lines = process.communicate(timeout=60)[1].splitlines()
    said = [line for line in lines if " of 20 frames in " not in line]  # a slow machine says so after ten seconds
    assert (process.returncode, said) == (130, ["stss: stopped; to go on, give the same command with --resume"])
    assert not [path for path in out.rglob("*") if path.name.startswith(".")]
    with pytest.raises(ProcessLookupError):  # noqa: PT012
        for _ in range(300):  # multiprocessing's own helper ends a moment later
            os.killpg(process.pid, 0)
            time.sleep(0.1)


@pytest.fixture
def scheduler():
    """A scheduler and two workers in threads of this process, reached through sockets."""
    distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, memory_limit=0, silence_logs=50, processes=False, protocol="tcp",
        scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"}, worker_dashboard_address=None,
    ) as cluster:  # fmt: skip
        yield cluster


NEVER = threading.Event()
HUNG = []


def hang_once(work, numbers):
    if not HUNG:
        HUNG.append(numbers)
        NEVER.wait()
    return compute_chunk(work, numbers)


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 takes modules from the current folder")
def test_modules_of_the_current_folder_are_the_users(write_frames, tmp_path):
    """Python's own start-up imports types; the pool's processes took it from the folder in which the command was given."""
    program = Path(sys.executable).with_name("stss")
    if not program.exists():
        pytest.skip("stss is not installed as a command")
    lr = write_frames(range(2), size=SIZE)
    (tmp_path / "types.py").write_text("raise SystemExit('the user's')")
    words = [program, "run", lr, "-o", "out", *PLAIN, "--cluster", "local:1"]
    process = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert "the user's" not in process.stderr


def test_a_machine_without_shared_memory_is_told(monkeypatch):
    """As a function's container, whose /dev/shm is missing or cannot be written to."""

    def refuse(*_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("multiprocessing.context.SpawnContext.Lock", refuse)
    with (
        pytest.raises(
            InputError, match=r"^--cluster local:2: processes share no lock here: /dev/shm: Read-only file system; run w"
        ),
        connect("local:2") as workers,
    ):
        workers.start()


def test_a_worker_of_a_scheduler_may_hang(scheduler, frames, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MIN_TIMEOUT", 1.0)
    monkeypatch.setattr(module, "TIMEOUT_FACTOR", 3.0)
    monkeypatch.setattr(module, "compute_chunk", hang_once)
    try:
        on_cluster(frames, tmp_path / "many", scheduler.scheduler_address)
        assert HUNG
    finally:
        NEVER.set()
    assert_as_in_one_process(frames, tmp_path / "many")


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("local:x", "local:N"),
        ("nowhere", "tcp://host:8786"),
        ("tcp://127.0.0.1:1", "no scheduler answers"),
    ],
)
def test_an_address_that_is_none_is_one_line(address, words, monkeypatch):
    if address.startswith("tcp"):
        pytest.importorskip("distributed", reason="the extra cluster is not installed")
    monkeypatch.setattr("stss.cluster.workers.TIMEOUT", 1)
    with pytest.raises(InputError, match=words) as error, connect(address):
        pass
    assert "\n" not in str(error.value)
