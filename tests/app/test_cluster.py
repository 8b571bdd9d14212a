"""`stss run --cluster`: the files of one process, whatever becomes of the workers."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from stss.frames.backends import open_backend
from stss.frames.compute_options import ComputeOptions
from stss.run.job import run
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss.weights.file import BILINEAR, load
from stss_ground.errors import InputError
from stss_ground.output.folder import OutputFolder
from stss_ground.output.write_whole import write_part
from stss_ground.version import VERSION

FRAMES = range(20)
SIZE = (8, 8)


@pytest.fixture
def frames(write_frames):
    return open_sequence(write_frames(FRAMES, rendered=set(range(0, 20, 2)), size=SIZE), "stss")


def test_a_folder_adopts_what_another_process_wrote(tmp_path):
    folder = OutputFolder(tmp_path / "out", ("",), r"\d+\.bin")
    with folder.opened(refusal=None):
        part = write_part(tmp_path / "out" / "1.bin", b"whole")
        assert not (tmp_path / "out" / "1.bin").exists()
        folder.adopt("1.bin", part, "0" * 64)
        assert not folder.holds("1.bin")  # the list has another sum: it is not what was promised
        folder.write("2.bin", b"own")
        folder.finish(remove_others=False)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["1.bin", "2.bin", "stss.sha256"]


# What follows needs the extra cluster.


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and two workers on this machine, in processes of their own."""
    distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")
    from stss.cluster.client import ANY_PORT

    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        scheduler_kwargs=ANY_PORT,
        worker_dashboard_address=None,
        silence_logs=50,
        memory_limit=0,
    ) as processes:
        yield processes


def test_workers_started_here_keep_their_memory(monkeypatch):
    """Dask would have glibc give it back to the system after each frame; a run took 1.7 times as long so."""
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    from stss.cluster.client import connected

    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
    with connected("local:1") as client:
        (found,) = client.run(os.environ.get, "MALLOC_TRIM_THRESHOLD_").values()
    assert found is None


def on_cluster(sequence, out, where, *, options=None, on_frame=lambda report: None, **chosen):
    from stss.cluster.run import Cluster, run_on_cluster

    chosen = {"method": "network", "backend": "ref", "compute": ComputeOptions(), **chosen}
    address = where if isinstance(where, str) else where.scheduler_address
    shortest = chosen.pop("shortest", 60.0)
    return run_on_cluster(
        sequence, out, Cluster(address, chosen.pop("mixed", False), shortest), loaded=load(BILINEAR), options=options or RunOptions(),
        on_frame=on_frame, **chosen,
    )  # fmt: skip


def in_one_process(sequence, out, **options):
    weights = load(BILINEAR)
    return run(sequence, out, open_backend("ref", weights.weights), weights.label, RunOptions(**options))


def files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


def test_the_files_are_those_of_one_process(cluster, frames, tmp_path):
    told = []
    found = on_cluster(frames, tmp_path / "many", cluster, on_frame=told.append)
    alone = in_one_process(frames, tmp_path / "one")
    assert files(tmp_path / "many") == files(tmp_path / "one")
    assert found.frames == alone.frames
    assert sorted(report.number for report in told) == list(FRAMES)


def test_files_come_home_where_no_storage_is_shared(cluster, frames, tmp_path, monkeypatch):
    """Workers that do not see the folder's lock send bytes."""
    monkeypatch.setattr("stss.cluster.run.LOCK", "stss.sha256")  # so they compare the lock with another file's bytes
    on_cluster(frames, tmp_path / "many", cluster)
    in_one_process(frames, tmp_path / "one")
    assert files(tmp_path / "many") == files(tmp_path / "one")


def test_a_bad_frame_is_reported_as_in_one_process(cluster, write_frames, tmp_path):
    def spoil(number, channels):
        if number == 13:
            channels["R" if "R" in channels else "normal.X"][2, 3] = np.nan

    folder = write_frames(FRAMES, rendered=set(range(0, 20, 2)), size=SIZE, change=spoil)
    sequence, said = open_sequence(folder, "stss"), []
    for work in (lambda out: on_cluster(sequence, out, cluster), lambda out: in_one_process(sequence, out)):
        with pytest.raises(InputError) as caught:
            work(tmp_path / f"out{len(said)}")
        said.append(str(caught.value))
    assert said[0] == said[1]
    assert all((tmp_path / "out0" / f"frame.{n:04d}.exr").exists() for n in range(13))
    found = on_cluster(sequence, tmp_path / "on", cluster, options=RunOptions(keep_going=True))
    alone = in_one_process(sequence, tmp_path / "alone", keep_going=True)
    assert found.frames == alone.frames
    assert files(tmp_path / "on") == files(tmp_path / "alone")


def test_resume_keeps_what_is_right_and_makes_the_rest(cluster, frames, tmp_path):
    out = tmp_path / "out"
    in_one_process(frames, out)
    whole = files(out)
    (out / "frame.0003.exr").write_bytes(b"damaged")
    (out / "frame.0017.exr").unlink()
    with pytest.raises(InputError, match="--resume"):
        on_cluster(frames, out, cluster)
    found = on_cluster(frames, out, cluster, options=RunOptions(resume=True))
    assert [report.number for report in found.frames if report.outcome == "done"] == [3, 17]
    assert files(out) == whole


def kill_one(cluster):
    """Returns a function to call with reports: at the first one it kills a worker that has a chunk; and the list of those killed."""
    killed = []

    def kill(report):
        del report
        client = cluster.get_client()
        busy = [address for address, keys in client.processing().items() if keys]
        if busy and not killed:
            os.kill(client.run(os.getpid, workers=busy[:1], nanny=False)[busy[0]], signal.SIGKILL)
            killed.append(busy[0])

    return kill, killed


def test_a_worker_that_dies_loses_nothing(cluster, frames, tmp_path):
    """It is killed when the first frames are in."""
    kill, killed = kill_one(cluster)
    on_cluster(frames, tmp_path / "many", cluster, on_frame=kill)
    assert killed, "nobody was killed: all chunks were done"
    in_one_process(frames, tmp_path / "one")
    assert files(tmp_path / "many") == files(tmp_path / "one")


def test_a_chunk_that_ends_its_workers_ends_the_run(cluster, frames, tmp_path, monkeypatch):
    monkeypatch.setattr("stss.cluster.run.MOST_DEATHS", 0)
    kill, killed = kill_one(cluster)
    with pytest.raises(InputError, match="every worker that computed them ended, tcp://") as caught:
        on_cluster(frames, tmp_path / "many", cluster, on_frame=kill)
    assert str(caught.value).endswith(f"{killed[0]} last")


def test_a_worker_that_hangs_loses_nothing(cluster, frames, tmp_path, monkeypatch):
    """A worker is stopped, not ended: another one is given its chunk as well."""
    monkeypatch.setattr("stss.cluster.client.FAREWELL", 0.5)
    stopped = []

    def stop(report):
        del report
        client = cluster.get_client()
        busy = [address for address, keys in client.processing().items() if keys]
        if not stopped and len(busy) == 1:  # so the other one is free
            stopped.append(client.run(os.getpid, workers=busy, nanny=False)[busy[0]])
            os.kill(stopped[0], signal.SIGSTOP)

    try:
        on_cluster(frames, tmp_path / "many", cluster, on_frame=stop, shortest=0.2)
        assert stopped, "nobody was stopped: all chunks were done"
        found = files(tmp_path / "many")
    finally:
        for process in stopped:
            os.kill(process, signal.SIGCONT)
    in_one_process(frames, tmp_path / "one")
    assert found == files(tmp_path / "one")


def test_two_clusters_on_one_machine_do_not_get_in_each_others_way(cluster):
    """Dask would warn of a port; a warning is an error here."""
    from stss.cluster.client import connected

    with connected("local:1") as one, connected("local:1") as other:
        addresses = {next(iter(client.scheduler_info()["workers"])) for client in (one, other)}
    assert len(addresses) == 2


def test_workers_of_different_kinds_are_refused_unless_asked_for(cluster, frames, tmp_path, monkeypatch):
    from stss.cluster.client import Crew
    from stss.cluster.worker import Introduction

    def different(self):
        return {address: Introduction(VERSION, f"device {i}") for i, address in enumerate(self.addresses())}

    monkeypatch.setattr(Crew, "introductions", different)
    with pytest.raises(InputError, match=r"device 0; device 1; --mixed-devices"):
        on_cluster(frames, tmp_path / "out", cluster)
    # A worker that came later, of a kind that nobody introduced, is refused as well.
    with pytest.raises(InputError, match="came later computes by ref; expected device 0, device 1"):
        on_cluster(frames, tmp_path / "out2", cluster, mixed=True)


def test_of_two_errors_at_once_the_first_frames_is_told(cluster, frames, tmp_path, monkeypatch):
    """All chunks have come in, each with an error, as they are looked at."""
    from stss.cluster import run as module
    from stss.cluster.client import Crew
    from stss.cluster.worker import Introduction

    def together(self):
        return sorted(module.distributed().wait(list(self._tasks)).done, key=lambda future: self._tasks[future].numbers[0])

    monkeypatch.setattr(Crew, "introductions", lambda self: dict.fromkeys(self.addresses(), Introduction(VERSION, "another")))
    monkeypatch.setattr(module._Coordinator, "_finished", together)
    with pytest.raises(InputError, match="came later computes by ref; expected another"):
        on_cluster(frames, tmp_path / "out", cluster)


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("local:0", "local:N"),
        ("local:x", "local:N"),
        ("nowhere", "tcp://host:8786"),
        ("tcp://127.0.0.1:1", "no scheduler answers"),
    ],
)
def test_an_address_that_is_none_is_one_line(frames, tmp_path, address, said, monkeypatch):
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    monkeypatch.setattr("stss.cluster.client.WAIT", 1)
    with pytest.raises(InputError, match=said) as caught:
        on_cluster(frames, tmp_path / "out", address)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_cut_is_refused():
    from stss.cluster.run import require_independent

    require_independent("network", None)
    for method, budget in (("taau", None), ("network", 0.04)):
        with pytest.raises(InputError, match="--cluster"):
            require_independent(method, budget)
