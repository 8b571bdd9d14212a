"""Fuzz ``stss port`` with damaged job folders: it answers or refuses each in one line, in time, and touches nothing outside.

``run(seed, seconds)`` is what ``make fuzz`` calls; case ``n`` of a seed is always the same one.
"""

import os
import shutil
import signal
import stat
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from conformance.protocol.job_folder import case_folders, read_outputs, read_stage, write_job
from conformance.protocol.program_port import smallest_case
from conformance.protocol.stages import STAGES, check_inputs
from stss.conform.own_ports import run_job
from stss_ground.errors import InputError

SECONDS = 20
"""Most seconds of a case; a longer one counts as a hang."""
CHEAP = ("motion_chain", "warp", "holes", "occlusion_warp", "rrm", "history")
PLACES = (
    "",
    "stage",
    "in",
    "out",
    "unsupported",
    "in/{name}.npy",
    "out/{name}.npy",
    "in/weights.safetensors",
    "in/.x",
    "in/x.npy",
)
NUMBERS = (0, 1, -1, 2**31, 2**63, 10**30, 10**400, 7, 8, 9)


def run(seed: int, seconds: float) -> int:
    """Damage job folders for so many seconds.

    Args:
        seed: of the cases.
        seconds: no case begins later.

    Returns:
        How many there were.

    Raises:
        AssertionError: one ended with a traceback, hung, or touched what lies outside; it names seed and case.
    """
    end, number = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        folder = Path(tempfile.mkdtemp(prefix="stss-fuzz-"))
        damage: list[str] = []
        try:
            _one(np.random.default_rng([seed, number]), folder, damage)
        except Exception as error:
            said = f"seed {seed}, case {number}: {'; '.join(damage)}: {type(error).__name__}: {error}"
            raise AssertionError(said) from error
        finally:
            _remove(folder)
        number += 1
    return number


def _one(random, folder, damage):
    job, outside = folder / "job", folder / "outside"
    stages = [str(random.choice(CHEAP)) for _ in range(random.integers(1, 3))]
    cases = [smallest_case(stage) for stage in stages]
    write_job(job, cases)
    outside.mkdir()
    shutil.copytree(job, outside / "job")
    (outside / "secret").write_text("mine")
    if random.random() < 0.3:
        run_job(job, "ref")
    for _ in range(random.integers(1, 4)):
        _damage(random, job, outside, stages, damage)
    before = _everything(outside)
    refused = None
    with _in_time():
        try:
            run_job(job, "ref")
        except InputError as error:
            refused = str(error)
    if refused is None:
        _whole(job)
    else:
        assert refused.isprintable(), f"not one line: {refused!r}"
    assert _everything(outside) == before, "something outside was touched"


def _whole(job):
    """An accepted job has no link that would be followed, and its answers can be judged."""
    for case in case_folders(job):
        stage = read_stage(case)
        if stage in STAGES:
            inputs = {key: np.load(case / "in" / f"{key}.npy") for key in STAGES[stage].inputs}
            read_outputs(case, stage, check_inputs(stage, inputs))
        else:
            assert (case / "unsupported").is_file()


def _damage(random, job, outside, stages, damage):
    stage = stages[random.integers(len(stages))]
    names = [*STAGES[stage].inputs, *STAGES[stage].outputs]
    place = str(random.choice(PLACES)).format(name=random.choice(names))
    path = job / f"000{random.integers(len(stages))}" / place
    how = DAMAGE[random.integers(len(DAMAGE))]
    damage.append(f"{how.__name__[1:]} {path.relative_to(job)}")
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ValueError("a pipe already")  # to read it would wait for ever
        how(random, path, outside)
    except (OSError, ValueError) as error:
        damage[-1] += f" (not done: {error})"


def _bytes(random, path, _):
    """Some bytes are others."""
    data = bytearray(path.read_bytes())
    # Most of what is read first: headers.
    for _ in range(random.integers(1, 6)):
        data[random.integers(min(len(data), int(random.choice([12, 140, len(data)]))))] = random.integers(256)
    path.write_bytes(data)


def _cut(random, path, _):
    os.truncate(path, int(random.integers(path.stat().st_size + 1)))


def _grown(random, path, _):
    os.truncate(path, int(random.choice([2**10, 2**36])))


def _header(random, path, _):
    """A whole .npy file with a wrong header."""
    shape = tuple(
        int(random.choice([8, 3, 2, 1])) if random.random() < 0.6 else NUMBERS[random.integers(len(NUMBERS))] for _ in range(3)
    )
    kind = random.choice(["<f4", "<f8", ">f4", "|u1", "<i4", "|O", "<U3", "|V4", "<c8", "<m8", "|b1", "x"])
    text = f"{{'descr': '{kind}', 'fortran_order': {random.random() < 0.5}, 'shape': {shape}, }}"
    text = "(" * 300 + text if random.random() < 0.1 else text
    size = abs(int(np.prod(np.array(shape, object)))) * 4
    path.write_bytes(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode())
    if size < 2**42:
        os.truncate(path, path.stat().st_size + size)


def _gone(_, path, __):
    _clear(path)


def _link(random, path, outside):
    """To something outside that would do in its place, or to nothing, or to itself."""
    job = outside / "job" / path.relative_to(path.parents[len(path.parts) - len(outside.parts) - 1])
    target = [job, outside / "secret", outside, outside / "nothing", path][random.integers(5)]
    _clear(path)
    path.symlink_to(target if random.random() < 0.5 else os.path.relpath(target, path.parent))


def _hard_link(_, path, outside):
    _clear(path)
    os.link(outside / "secret", path)


def _pipe(_, path, __):
    _clear(path)
    os.mkfifo(path)


def _device(random, path, _):
    _clear(path)
    os.mknod(path, 0o20666, os.makedev(1, int(random.choice([3, 5]))))


def _folder(_, path, __):
    _clear(path)
    path.mkdir()


def _file(random, path, _):
    _clear(path)
    path.write_bytes(random.bytes(int(random.integers(200))))


def _closed(random, path, _):
    path.chmod(int(random.choice([0, 0o111, 0o444])))


def _stranger(random, path, _):
    """A file beside it, of any name."""
    name = bytes(random.integers(1, 256, int(random.integers(1, 255)), dtype=np.uint8)).replace(b"/", b"_")
    Path(os.fsdecode(os.fsencode(path.parent) + b"/" + name + bytes(random.choice([b"", b".npy"])))).touch()


def _stage(random, path, _):
    name = str(random.choice([*STAGES, "later_stage", "..", "warp\nwarp", "\x1b[2J", ""]))
    (path.parent / "stage").write_text(name)


DAMAGE = (
    _bytes, _bytes, _bytes, _cut, _grown, _header, _header, _header, _gone, _link, _link, _hard_link, _pipe, _device, _folder,
    _file, _closed, _stranger, _stage,
)  # fmt: skip


def _clear(path):
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _everything(folder):
    found = {}
    for path in sorted(folder.rglob("*")):
        status = path.lstat()
        held = path.read_bytes() if stat.S_ISREG(status.st_mode) and status.st_size < 2**24 else None
        found[path] = status.st_mode, status.st_size, status.st_mtime_ns, held
    return found


def _remove(folder):
    for path in folder.rglob("*"):
        if path.is_dir() and not path.is_symlink():
            path.chmod(0o700)
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _in_time():
    """A case that hangs is interrupted, where the system can."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "SIGALRM"):
        yield
        return

    def late(*_):
        raise AssertionError(f"a hang: more than {SECONDS} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
