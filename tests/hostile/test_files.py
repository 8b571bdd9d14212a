"""Files: nothing that is read is lost, nothing is half-written, one run at a time in a folder."""

import errno
import os
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import tracemalloc
from functools import partial
from pathlib import Path

import click
import numpy as np
import pytest

from stss.cli.main import stss as stss_group
from stss.images.read_write import write_rgb
from stss.sequence.profiles import load_profile
from stss_ground.commands import Subcommand
from stss_ground.errors import InputError
from stss_ground.option_kinds import ReadName, ReadPath, WrittenFile, WrittenFolder
from stss_ground.output.folder import SUMS, OutputFolder
from stss_ground.output.lock import LOCK, hold_lock
from stss_ground.output.write_whole import write_named, write_whole
from tests.app.conftest import PLAIN
from tests.app.conftest import files as contents
from tests.hostile.cases import call, refused, stss, unprivileged

FRAMES = 4


@pytest.fixture(scope="module")
def finished_run(demo, tmp_path_factory):
    """The output of a run of these frames."""
    out = tmp_path_factory.mktemp("finished") / "out"
    assert call("run", demo / "frames", "-o", out, *PLAIN).returncode == 0
    return out


@pytest.fixture
def out(finished_run, tmp_path):
    """A copy of it, that a test may change."""
    return shutil.copytree(finished_run, tmp_path / "out")


@pytest.fixture
def inputs(demo, tmp_path):
    """The frames under the names of outputs, and some that are not written to."""
    folder = tmp_path / "X"
    folder.mkdir()
    for number in range(FRAMES):
        shutil.copy(demo / "frames" / f"demo.{number:04d}.exr", folder / f"frame.{number:04d}.exr")
    return folder


@pytest.fixture
def as_windows(monkeypatch):
    """No file that this process has open is replaced or removed, as on Windows."""

    def guard(method):
        def call_it(path, *arguments, **options):
            for place in (path, *arguments):
                opened = (Path(entry) for entry in os.scandir("/proc/self/fd"))
                if os.path.realpath(place) in {os.path.realpath(entry) for entry in opened}:
                    raise PermissionError(errno.EACCES, "Access is denied", str(place))
            return method(path, *arguments, **options)

        return call_it

    monkeypatch.setattr(Path, "replace", guard(Path.replace))
    monkeypatch.setattr(Path, "unlink", guard(Path.unlink))


@pytest.mark.skipif(sys.platform != "linux", reason="/proc tells what is open")
def test_a_run_replaces_and_removes_no_open_file(demo, tmp_path, as_windows):
    for options in ((), ("--resume",), ("--overwrite", "--format", "png")):
        result = call("run", demo / "frames", "-o", tmp_path / "parts" / "1", *PLAIN, *options)
        assert result.returncode == 0, result.stderr
        (tmp_path / "parts" / "1" / LOCK).unlink(missing_ok=True)  # Windows removes it when it is released
    assert call("gather", tmp_path / "parts", "-o", tmp_path / "out").returncode == 0
    assert call("compare", tmp_path / "out", demo / "truth", "--html", tmp_path / "a.html").returncode == 0


def refused_untouched(folder, arguments, *words):
    """The command is refused, and nothing in the folder has changed."""
    before = contents(folder)
    refused(call(*arguments), *words)
    assert contents(folder) == before


PLACES = {
    "the same folder": "out=X",
    "a link to the folder": "ln -s X out",
    "links to the files": "cp -rs $PWD/X out",
    "hard links": "cp -rl X out",
    # No output has such a name; but --overwrite removes what looks like a frame of an earlier run.
    "a number of more digits": "out=X; for n in 0 1 2 3; do mv X/frame.000$n.exr X/frame.0000$n.exr; done",
}
"""Shell commands that lay ``out``, or what ``$out`` then names, over the inputs in ``X``."""


def laid(folder, command):
    """Run it in the folder of ``X``; the output's folder."""
    command = f"{command}; echo ${{out:-out}}"
    return folder / subprocess.run(["sh", "-c", command], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


@pytest.mark.parametrize("option", ["--overwrite", "--resume"])
@pytest.mark.parametrize("place", PLACES)
def test_no_input_is_an_output(inputs, tmp_path, place, option):
    out = laid(tmp_path, PLACES[place])
    refused_untouched(tmp_path, ("run", inputs, "-o", out, option, *PLAIN), "the same file as", "which is read")


@pytest.mark.parametrize("place", ["out=X", "ln -s X out", "mkdir out; ln -s ../X out/holes"])
def test_no_output_lies_among_the_inputs(inputs, tmp_path, place):
    """Not even under other names: the same command would find two sequences there the next time."""
    out = laid(tmp_path, f"cd X; for f in *; do mv $f a$f; done; cd ..; {place}")
    words = "the folder of the frames that are read; expected another one"
    refused_untouched(tmp_path, ("run", inputs, "-o", out, *PLAIN), words)


def test_no_input_is_an_output_even_of_an_earlier_run(out, demo):
    """The frames of a run serve as inputs of the next one: their list says that stss wrote them, but they are read."""
    for number in range(FRAMES):
        shutil.copy(demo / "frames" / f"demo.{number:04d}.exr", out / f"frame.{number:04d}.exr")
    refused_untouched(out, ("run", out, "-o", out, "--overwrite", *PLAIN), "the same file as")


@pytest.mark.parametrize("option", ["--overwrite", "--resume"])
def test_frames_of_others_are_not_replaced(inputs, demo, option):
    command = ("run", demo / "frames", "-o", inputs, option, *PLAIN)
    refused_untouched(inputs, command, "frame.0000.exr", "not from an earlier run")


@pytest.mark.parametrize("option", ["--camera", "--profile", "--weights"])
def test_no_table_that_is_read_is_an_output(out, demo, weights, tmp_path, option):
    """Each is made the first output by a link."""
    table, number = tmp_path / {"--camera": "c.csv", "--profile": "p.toml", "--weights": "w.safetensors"}[option], range(FRAMES)
    if option == "--camera":
        table.write_text("frame,x,y,z\n" + "".join(f"{n},0,0,0\n" for n in number))
    else:
        shutil.copy(load_profile("stss").path if option == "--profile" else weights, table)
    (out / "frame.0000.exr").unlink()
    (out / "frame.0000.exr").symlink_to(table)
    command = ("run", demo / "frames", "-o", out, "--overwrite", *PLAIN, option, table)
    refused_untouched(tmp_path, command, "the same file as", table)


@pytest.mark.parametrize(
    "command",
    [
        "weights import {w} -o {w}",
        "weights import {w} -o {link}",
        "weights import {w} -o {hard}",
        "export {w} -o {link} --size 16x16",
        "bench --weights {w} --json {w}",
        "conform --exec true --known-failures {w} --report {link}",
        "conform --exec true --junit {new} --json {new}",
        "conform --exec true --junit {new} --json {folder}/../new.safetensors",
        "methods {frames} {truth} -o {folder} --methods bilinear --html {folder}/bilinear/frame.0001.exr",
        "compare {out} {truth} --html {out}/stss.sha256",
        "compare {out} {truth} --frames 0:1 --html {truth}/demo.0003.exr",
        "conform --exec {port} --json {port}",
        "conform --exec {link} --json {w}",
        "conform --exec true\\ --table={port} --json {port}",
        "conform --exec sh\\ -c\\ 'exec\\ {port}' --junit {port}",
        "conform --port mine:Port --report {folder}/../mine.py",
        "conform --port mine:Port --json {folder}/../helper.py",
        "conform --exec true --junit {folder}/../New.json --json {folder}/../new.json",
    ],
)
def test_no_file_that_is_named_twice_is_written(weights, out, demo, tmp_path, command, monkeypatch):
    """Nor one that the command writes, or knows by its name, anyway."""
    names = {name: tmp_path / f"{name}.safetensors" for name in ("w", "link", "hard", "new")}
    shutil.copy(weights, names["w"])
    monkeypatch.chdir(tmp_path)
    names["port"] = tmp_path / "port.sh"
    names["port"].write_text("exit 1")
    (tmp_path / "mine.py").write_text("from helper import Port")
    (tmp_path / "helper.py").write_text("from stss.port import ReferencePort as Port")
    names["link"].symlink_to(names["w"])
    names["hard"].hardlink_to(names["w"])
    names |= {name: tmp_path / name for name in ("frames", "truth", "out", "folder")}
    for name in ("frames", "truth"):
        shutil.copytree(demo / name, names[name])
    names["folder"].mkdir()
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name in ("mine", "helper"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    refused_untouched(tmp_path, shlex.split(command.format(**names)), "the same file as")


def commands(group=stss_group, *names):
    """Name -> each command of ``stss``."""
    for name in group.list_commands(None):
        command = group.get_command(None, name)
        if isinstance(command, click.Group):
            yield from commands(command, *names, name)
        else:
            yield (*names, name), command


PAIRS = [
    (names, command, source, output)
    for names, command in commands()
    for source in command.params
    for output in command.params
    if isinstance(source.type, (ReadPath, ReadName)) and isinstance(output.type, WrittenFile)
]


def test_every_command_says_what_it_reads_and_writes():
    """By the kinds of its parameters; what is text names no file."""
    texts = {"device", "cluster", "spec", "shapes"}
    all_commands = dict(commands())
    assert {("run",), ("weights", "import"), ("bench",)} <= all_commands.keys()
    for names, command in all_commands.items():
        assert isinstance(command, Subcommand), names
        for parameter in command.params:
            if isinstance(parameter.type, (click.types.StringParamType, click.File, click.Path)):
                kinds = (ReadPath, WrittenFile, WrittenFolder)
                assert isinstance(parameter.type, kinds) or parameter.name in texts, (names, parameter.name)


@pytest.mark.parametrize(("names", "command", "read", "output"), PAIRS, ids=lambda v: getattr(v, "name", None) or " ".join(v))
def test_no_command_writes_what_it_reads(tmp_path, names, command, read, output):
    """Whatever it reads, and whatever link leads there."""
    mine, link, hard, loop = (tmp_path / name for name in ("mine", "link", "hard", "loop"))
    mine.write_bytes(b"mine")
    link.symlink_to(mine)
    hard.hardlink_to(mine)
    loop.symlink_to(tmp_path)
    for one, other in ((mine, mine), (mine, link), (link, mine), (mine, hard), (mine, loop / "mine")):
        arguments = {p: tmp_path / "no" for p in command.params if p.required} | {read: one, output: other}
        words = [word for p, v in arguments.items() for word in ([v] if isinstance(p, click.Argument) else [p.opts[-1], v])]
        refused_untouched(tmp_path, (*names, *words), "the same file as", "which is read")


@pytest.mark.parametrize(
    ("names", "command", "place"),
    [
        (names, command, place)
        for names, command in commands()
        for place in command.params
        if isinstance(place.type, (ReadPath, ReadName, WrittenFile, WrittenFolder))
    ],
    ids=lambda v: getattr(v, "name", None) or " ".join(v),
)
def test_an_empty_name_is_not_the_current_folder(tmp_path, monkeypatch, names, command, place):
    """A script's ``-o "$OUT"`` without an OUT would write there, and with --overwrite remove."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frame.0000.exr").write_bytes(b"mine")
    arguments = {p: tmp_path / "no" for p in command.params if p.required} | {place: ""}
    words = [word for p, v in arguments.items() for word in ([v] if isinstance(p, click.Argument) else [p.opts[-1], v])]
    refused_untouched(tmp_path, (*names, *words), "expected a name, got an empty text")


def test_an_equals_sign_behind_a_short_option_is_no_name(tmp_path, monkeypatch):
    """``-o=out`` would make a folder of the name ``=out``."""
    monkeypatch.chdir(tmp_path)
    refused_untouched(tmp_path, ("run", "no", "-o=out"), "expected a name, got =out; write --out=out, or -o out")


def test_overwrite_removes_nothing_before_the_new_frames_are_there(out, demo, tmp_path):
    """A frame in the middle cannot be read: the frames before it are new, the frames behind it are from the earlier run."""
    frames = shutil.copytree(demo / "frames", tmp_path / "frames")
    (frames / "demo.0002.exr").write_bytes((frames / "demo.0002.exr").read_bytes()[:-10])  # its header does not tell
    before = contents(out)
    refused(call("run", frames, "-o", out, "--overwrite", "--depth", "clip", *PLAIN), "demo.0002.exr")
    after = contents(out)
    assert after.keys() == before.keys()
    assert {name for name in before if before[name] != after[name]} == {"frame.0000.exr", "frame.0001.exr", SUMS}


def test_overwrite_removes_what_is_left_of_the_earlier_run_at_its_end(finished_run, out, demo, tmp_path):
    (out / "notes.txt").write_text("mine")
    frames = shutil.copytree(demo / "frames", tmp_path / "frames")
    for path in sorted(frames.iterdir())[2:]:
        path.unlink()
    assert call("run", frames, "-o", out, "--overwrite", *PLAIN).returncode == 0
    assert sorted(contents(out)) == ["frame.0000.exr", "frame.0001.exr", "holes/frame.0001.png", "notes.txt", SUMS]
    assert contents(out)["frame.0001.exr"] == contents(finished_run)["frame.0001.exr"]


def test_overwrite_of_some_frames_leaves_the_others(finished_run, out, demo):
    """Those outside of the range: they are of the same run, or the command is refused before it writes."""
    name = "frame.0002.exr"
    (out / name).unlink()
    before = contents(out)
    words = ("run", demo / "frames", "-o", out, "--overwrite", "--frames", "2:2", *PLAIN)
    refused(call(*words, "--depth", "clip"), "frame.0000.exr: depth scale, not clip: --overwrite --frames 2:2 would mix two runs")
    refused(call(*words, "--format", "png"), "frame.0000.exr: format exr, not png")
    # And before a device is opened, whose kernels may take a minute.
    before_device = ("run", demo / "frames", "-o", out, "--overwrite", "--frames", "2:2", "--device", "no such")
    refused(call(*before_device), "would mix two runs")
    assert contents(out) == before
    assert call(*words).returncode == 0
    assert contents(out) == contents(finished_run)
    # Frames within the range may have any settings: they are replaced.
    for path in (*out.glob("frame.000[013].exr"), *(out / "holes").iterdir()):
        path.unlink()
    assert call(*words, "--depth", "clip").returncode == 0
    assert contents(out)[name] != contents(finished_run)[name]


DAMAGE = {
    "cut": lambda data, other: data[: len(data) // 2],
    "a bit flipped": lambda data, other: data[:-40] + bytes([data[-40] ^ 16]) + data[-39:],
    "longer": lambda data, other: data + b"\0",
    "another frame's": lambda data, other: other,
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", ["frame.0000.exr", "holes/frame.0001.png"])
def test_resume_keeps_only_what_is_as_it_was_written(finished_run, out, demo, name, damage):
    data = DAMAGE[damage]((out / name).read_bytes(), (out / "frame.0002.exr").read_bytes())
    (out / name).write_bytes(data)
    assert count_kept(demo, out) == FRAMES - 1
    assert contents(out) == contents(finished_run) | {f"{name}.1.aside": data}
    assert count_kept(demo, out) == FRAMES


@pytest.mark.parametrize("option", ["--overwrite", "--resume"])
def test_a_file_of_others_under_a_listed_name_is_moved_aside(finished_run, out, demo, tmp_path, option):
    """Its checksum says that it is not what the run wrote; with --overwrite one of them would be replaced and one removed."""
    for name in ("frame.0002.exr", "frame.0003.exr"):
        (out / name).write_bytes(b"mine")
    (out / "frame.0003.exr.1.aside").write_bytes(b"mine of old")
    frames = shutil.copytree(demo / "frames", tmp_path / "frames")
    if option == "--overwrite":
        (frames / "demo.0003.exr").unlink()
    result = call("run", frames, "-o", out, option, *PLAIN)
    assert result.returncode == 0
    assert (
        "frame.0002.exr: not as stss.sha256 says, so another program wrote it: moved to frame.0002.exr.1.aside" in result.stderr
    )
    files_now = contents(out)
    asides = [files_now[f"frame.{name}.aside"] for name in ("0002.exr.1", "0003.exr.2", "0003.exr.1")]
    assert asides == [b"mine", b"mine", b"mine of old"]
    assert files_now["frame.0002.exr"] == contents(finished_run)["frame.0002.exr"]
    assert ("frame.0003.exr" in files_now) == (option == "--resume")


def test_no_page_of_others_is_replaced(tmp_path):
    out = tmp_path / "demo"
    out.mkdir()
    (out / "page.html").write_text("mine")
    before = contents(tmp_path)
    refused(call("demo", out, "--weights", "bilinear", "--overwrite"), "not in stss.sha256, so not from an earlier run")
    assert {name: data for name, data in contents(tmp_path).items() if not name.endswith(SUMS)} == before


def count_kept(demo, out, **more):
    """Resume in this process: how many frames were kept."""
    from stss.frames.backends import open_backend
    from stss.run.job import run
    from stss.run.options import RunOptions
    from stss.sequence.reader import open_sequence
    from stss.weights.file import load

    weights, sequence = load("bilinear"), open_sequence(demo / "frames", "stss")
    return run(sequence, out, open_backend("ref", weights), weights.label, RunOptions(resume=True), **more).count("kept")


def test_a_run_that_is_killed_can_be_resumed(finished_run, demo, tmp_path):
    """Killed as the third frame is to be renamed into place: its checksum is known, the file is not there."""
    out = tmp_path / "out"
    code = (
        "import os, pathlib, sys; from stss.cli.main import main; replace = pathlib.Path.replace\n"
        "def die(self, to):\n"
        "    if to.name == 'frame.0002.exr': os.kill(os.getpid(), 9)\n"
        "    return replace(self, to)\n"
        "pathlib.Path.replace = die; main()"
    )
    command = [sys.executable, "-c", code, "run", str(demo / "frames"), "-o", str(out), *PLAIN]
    assert subprocess.run(command, capture_output=True, check=False).returncode == -signal.SIGKILL
    parts = [path for path in out.iterdir() if path.suffix == ".part"]
    assert len(parts) == 1
    assert (out / LOCK).exists()
    assert count_kept(demo, out) == 2
    assert contents(out) == contents(finished_run)


def test_a_list_and_a_frame_of_any_length_take_no_memory(finished_run, out, demo, tmp_path):
    """Both of 512 MiB that take no place on the disk: the list is refused, the frame is another one."""
    os.truncate(out / "frame.0002.exr", 1 << 29)
    tracemalloc.start()
    try:
        assert count_kept(demo, out) == FRAMES - 1
        os.truncate(out / SUMS, 1 << 29)
        with pytest.raises(InputError, match="expected at most 64 MiB"):
            count_kept(demo, out)
        assert tracemalloc.get_traced_memory()[1] < 1 << 27
    finally:
        tracemalloc.stop()


LINES = {  # what comes to the end of the list -> how many frames are kept
    "0123": FRAMES,
    f"{'0' * 64}  ": FRAMES,
    f"{'0' * 64}  ../../secret": FRAMES,
    f"{'0' * 64}  holes/../frame.0000.exr": FRAMES,
    "\xff\xfe\0": FRAMES,
    # As in a run that was killed before it wrote the file: that of the earlier run is nobody else's.
    f"{'0' * 64}  frame.0002.exr\n": FRAMES - 1,
}


@pytest.mark.parametrize("line", LINES)
def test_a_damaged_list_harms_nothing(finished_run, demo, tmp_path, line):
    out, secret = tmp_path / "a" / "b" / "out", tmp_path / "a" / "secret"
    shutil.copytree(finished_run, out)
    secret.write_text("mine")
    with (out / SUMS).open("a", encoding="latin-1") as file:
        file.write(line)
    assert count_kept(demo, out) == LINES[line]
    assert contents(out) == contents(finished_run)
    assert secret.exists()


@pytest.mark.parametrize("suffix", ["exr", "png"])
@pytest.mark.parametrize("size", [0, 1000])
def test_a_file_that_does_not_fit_is_no_file(finished_run, demo, tmp_path, suffix, size):
    """If the system refuses a write, the run fails, and no incomplete file remains.

    No file of the process may grow beyond ``size`` bytes, as on a full disk: one of its own, since others' threads may write, too.
    """
    out, limit = tmp_path / "out", partial(resource.setrlimit, resource.RLIMIT_FSIZE, (size, size))
    result = stss("run", demo / "frames", "-o", out, *PLAIN, "--format", suffix, preexec_fn=limit)
    refused(result, "cannot be written")
    assert not [path for path in contents(out) if path.endswith((suffix, ".part"))]


@pytest.fixture
def readable():
    """A folder that every user can reach; pytest's own are for their owner alone."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


@pytest.mark.parametrize("option", ["--overwrite", "--resume"])
def test_a_folder_of_somebody_else_is_told(finished_run, demo, readable, option):
    """The user may read everything and write nothing."""
    out, frames = readable / "out", readable / "frames"
    shutil.copytree(finished_run, out)
    shutil.copytree(demo / "frames", frames)
    for path in readable.rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    with unprivileged():
        result = call("run", frames, "-o", out, option, *PLAIN)
    refused(result, out, "Permission denied")
    assert contents(out) == contents(finished_run)
    for path in (out, out / "holes", frames):
        path.chmod(0o755)


@pytest.mark.parametrize("name", ["frame.0001.exr", "holes/frame.0001.png", "holes", SUMS, LOCK])
def test_a_folder_where_a_file_is_expected(out, demo, name):
    """And a file where a folder is."""
    if (out / name).is_dir():
        shutil.rmtree(out / name)
        (out / name).write_text("a file")
    else:
        (out / name).unlink(missing_ok=True)
        (out / name).mkdir()
    refused_untouched(out, ("run", demo / "frames", "-o", out, "--overwrite", *PLAIN), name.partition("/")[0])


NAMED = [
    ("export", "bilinear", "--size", "16x16", "-o"),
    ("bench", "--ours", "ref", "--peers", "", "--size", "16x16", "--repeat", "1", "--json"),
    ("conform", "--exec", "true", "--report"),
]


@pytest.mark.parametrize("arguments", NAMED, ids=lambda row: row[0])
def test_a_named_file_that_is_a_folder(tmp_path, arguments):
    refused(call(*arguments, tmp_path), tmp_path, "expected a file")
    refused(call(*arguments, tmp_path / "no" / "x"), tmp_path / "no" / "x", "expected a file")
    assert not list(tmp_path.iterdir())


def test_the_second_run_says_who_has_the_folder(demo, finished_run, tmp_path):
    """It ends with status 2, and the first one never knows: its temporary files are left alone."""
    out = tmp_path / "out"
    folder = OutputFolder(out, ("", "holes"), r"frame\.\d+\.(exr|png)")
    with folder.open(refusal=None):
        part = out / f".stss-{'0' * 12}.part"
        part.write_bytes(b"being written")
        before = contents(out)
        for option in ("--resume", "--overwrite"):
            refused(call("run", demo / "frames", "-o", out, option, *PLAIN), out, f"process {os.getpid()} on ", "writes there")
            assert contents(out) == before
        folder.write("frame.0000.exr", b"first")
        folder.finish(remove_others=False)
    assert not (out / LOCK).exists()
    assert (out / "frame.0000.exr").read_bytes() == b"first"


def test_without_locks_the_file_is_the_lock(tmp_path, monkeypatch):
    """As on a network file system without locks: who was killed leaves a file, and the message says what to do."""

    def no_lock(handle, how):
        raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))

    monkeypatch.setattr("fcntl.flock", no_lock)
    with (
        hold_lock(tmp_path),
        pytest.raises(InputError, match=r"writes there; if it ended long ago, remove .*\.stss-lock"),
        hold_lock(tmp_path),
    ):
        pass
    with hold_lock(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()


@pytest.mark.parametrize("how", ["link", "hard link", "text"])
def test_a_file_of_others_is_no_lock(tmp_path, how):
    """A second name of an input, or a file that the user called so, is neither emptied nor removed."""
    mine, lock = tmp_path / "mine", tmp_path / "out" / LOCK
    lock.parent.mkdir()
    mine.write_text("mine" if how == "text" else "process 1 on x since 2026\n")
    {"link": lock.symlink_to, "hard link": lock.hardlink_to, "text": lambda mine: shutil.copy(mine, lock)}[how](mine)
    before = contents(tmp_path)
    with pytest.raises(InputError, match="expected the lock of a run, found something else"), hold_lock(lock.parent):
        pass
    assert contents(tmp_path) == before


def test_a_file_that_the_user_named(tmp_path):
    """A link stays and its target is new; a device is written to, not replaced; the mode is that of any new file."""
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old")
    link.symlink_to(target)
    write_named(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    write_named(Path("/dev/null"), "gone")
    assert Path("/dev/null").is_char_device()
    with pytest.raises(InputError, match=r"/dev/full: cannot be written: No space"):
        write_named(Path("/dev/full"), "much")
    before = os.umask(0o027)
    try:
        write_named(tmp_path / "mode", b"")
    finally:
        os.umask(before)
    modes = [(tmp_path / "mode").stat().st_mode & 0o777]
    (tmp_path / "mode").chmod(0o600)
    write_named(tmp_path / "mode", b"secret")
    assert [*modes, (tmp_path / "mode").stat().st_mode & 0o777] == [0o640, 0o600]
    (tmp_path / "dangling").symlink_to(tmp_path / "there")
    write_named(tmp_path / "dangling", "new")
    assert (tmp_path / "dangling").is_symlink()
    assert (tmp_path / "there").read_text() == "new"
    write_whole(link, b"instead")
    assert not link.is_symlink()
    assert target.read_text() == "new"
    assert not [path for path in tmp_path.iterdir() if path.suffix == ".part"]


@pytest.mark.skipif(not hasattr(os, "fchmod"), reason="no modes here")
def test_a_share_without_modes_lets_a_file_be_replaced(tmp_path, monkeypatch):
    """All files of such a share have one mode, and setting it is refused."""

    def refuse(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "fchmod", refuse)
    for data in (b"old", b"new"):
        write_whole(tmp_path / "stss.sha256", data)
    assert (tmp_path / "stss.sha256").read_bytes() == b"new"


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_without_files_in_memory_a_cut_picture_is_found_too(tmp_path, monkeypatch, name):
    """OpenImageIO closes a file that was cut short as if all were well; here it is cut by hand."""
    monkeypatch.delattr(os, "memfd_create")
    picture = np.random.default_rng(0).random((40, 40, 3))
    write_rgb(tmp_path / name, picture)
    whole, read_bytes = (tmp_path / name).read_bytes(), Path.read_bytes
    for keep in (0, 9, len(whole) // 2, len(whole) - 1):
        monkeypatch.setattr(Path, "read_bytes", lambda path, keep=keep: read_bytes(path)[:keep])
        with pytest.raises(InputError, match="cut short"):
            write_rgb(tmp_path / name, picture)
        monkeypatch.setattr(Path, "read_bytes", read_bytes)
        assert (tmp_path / name).read_bytes() == whole


@pytest.mark.skipif(os.name != "posix", reason="a pipe that is closed")
def test_a_reader_that_leaves_is_told_from_a_finding(demo):
    """``stss ... | head``: 141, as of a program that SIGPIPE ends; 1 would be a warning."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "stss", "weights", "inspect", "bilinear"]
    result = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (result.returncode, result.stderr) == (141, "")


def test_a_mistake_is_status_2_where_no_message_can_be_written(tmp_path):
    with open("/dev/full", "w") as full:  # noqa: PTH123
        command = [sys.executable, "-m", "stss", "check", str(tmp_path / "nothing")]
        assert subprocess.run(command, stdout=subprocess.DEVNULL, stderr=full, check=False).returncode == 2


def test_what_is_printed_to_a_full_disk(demo):
    with open("/dev/full", "w") as full:  # noqa: PTH123
        command = [sys.executable, "-m", "stss", "weights", "inspect", "bilinear", "--json"]
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr == "stss: standard output cannot be written: No space left on device\n"
