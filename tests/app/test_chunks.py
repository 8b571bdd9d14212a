"""How `stss run --cluster` shares a run out, and what a worker does from chunk to chunk; without a cluster."""

import threading

import pytest

from stss.cluster.chunks import CHUNK, Lanes
from stss.cluster.worker import Work, Worker
from stss.frames.backends import open_backend
from stss.frames.compute_options import ComputeOptions
from stss.run.job import run
from stss.run.options import RunOptions
from stss.sequence.reader import Sequence, open_sequence
from stss.weights.file import BILINEAR, load
from stss_ground.output.lock import LOCK


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 100, 1000, 172_800])
@pytest.mark.parametrize("workers", [1, 2, 1000])
def test_lanes_hand_out_each_frame_once(count, workers):
    """Most chunks follow their worker's last one, as announced; and no worker does more than its share, within a chunk."""
    numbers, taken, followed = range(5, 5 + count), {worker: [] for worker in map(str, range(workers))}, 0
    lanes = Lanes(numbers)
    while lanes.left():
        for worker, chunks in taken.items():
            announced = lanes.after(worker)
            chunk = lanes.take(worker)
            if announced and chunk:
                assert chunk == announced
            followed += bool(announced)
            chunks.append(chunk)
    assert sorted(n for chunks in taken.values() for chunk in chunks for n in chunk) == list(numbers)
    assert max(len(chunk) for chunks in taken.values() for chunk in chunks or [()]) <= CHUNK
    rounds = {len(chunks) for chunks in taken.values()}
    assert len(rounds) == 1
    assert rounds.pop() == -(-count // (CHUNK * workers))
    assert followed >= count // CHUNK - 2 * workers * (1 + workers.bit_length())


def test_lanes_drop_what_comes_after_an_error():
    lanes = Lanes(range(100))
    lanes.take("a")
    lanes.take("b")
    lanes.drop(20)
    assert [lanes.take("a")[0] for _ in range(2)] == [8, 16]
    assert not lanes.left()
    assert not lanes.take("b")


def test_the_lane_of_a_worker_that_ended_goes_to_the_next_that_asks():
    lanes = Lanes(range(100))
    lost = lanes.take("a")
    lanes.take("b")
    rest = lanes.after("a")
    lanes.end("a", lost)
    assert lanes.after("a") == ()
    assert [lanes.take("c"), lanes.take("c")] == [lost, rest]


@pytest.fixture
def frames(write_frames):
    return open_sequence(write_frames(range(20), rendered=set(range(0, 20, 2)), size=(8, 8)), "stss")


@pytest.fixture
def worker(frames, tmp_path, monkeypatch):
    """A worker without a cluster, and the numbers of the frames that it reads."""
    reads, load_frame = [], Sequence.load

    def load_and_note(self, number, *, color):
        reads.append(number)
        return load_frame(self, number, color=color)

    monkeypatch.setattr(Sequence, "load", load_and_note)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / LOCK).write_bytes(b"held")
    rendered = frozenset(range(0, 20, 2))
    work = Work(frames, rendered, RunOptions(), "network", load(BILINEAR), "ref", ComputeOptions(), tmp_path / "out", b"held")
    return Worker(work), reads


def parts(chunk):
    return [file.part for _, files in chunk.frames for file in files]


def test_a_worker_reads_nothing_again_for_the_next_chunk(worker, frames, tmp_path):
    """Whether or not it was announced; and what was announced is under way when the chunk before it comes back."""
    worker, reads = worker
    backends = frozenset(["ref"])
    chunks = [worker.compute(range(8), range(8, 16), backends)]
    assert max(reads) > 7
    chunks.append(worker.compute(range(8, 16), (), backends))
    assert max(reads) == 15
    chunks.append(worker.compute(range(16, 20), (), backends))
    assert reads == list(range(20))
    assert not any(chunk.error for chunk in chunks)
    weights = load(BILINEAR)
    run(frames, tmp_path / "one", open_backend("ref", weights.weights), weights.label, RunOptions())
    for file in (file for chunk in chunks for _, of_frame in chunk.frames for file in of_frame):
        assert file.part.read_bytes() == (tmp_path / "one" / file.name).read_bytes()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("stss-")]


def test_what_was_announced_and_is_not_asked_for_leaves_nothing(worker, tmp_path):
    worker, _ = worker
    backends = frozenset(["ref"])
    taken = parts(worker.compute(range(8), range(8, 16), backends)) + parts(worker.compute(range(12, 16), (), backends))
    left = [path for path in (tmp_path / "out").rglob("*") if path.is_file() and path.name != LOCK]
    assert sorted(left) == sorted(taken)


def test_a_bad_frame_that_was_announced_is_an_error_of_its_own_chunk(worker, frames):
    worker, _ = worker
    frames.files(9)[0].write_bytes(b"damaged")
    backends = frozenset(["ref"])
    first = worker.compute(range(8), range(8, 16), backends)
    assert (len(first.frames), first.error) == (8, "")
    second = worker.compute(range(8, 16), (), backends)
    assert [report.number for report, _ in second.frames] == [8]
    assert "0009" in second.error
