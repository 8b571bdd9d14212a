"""What ``stss`` is handed: numbers, names and files that no renderer writes; each is refused in one line, at once."""

import os
import subprocess
import sys

import numpy as np
import pytest

from stss.images.read_write import write_rgb
from stss.sequence.reader import open_sequence
from stss_ground.errors import InputError
from tests.app.conftest import frame_channels, write_raw
from tests.hostile.cases import call, refused

SIZE = (8, 16)
PLAIN = ("--weights", "bilinear", "--backend", "ref")
FAR = 99999999


def write(path, number=1, change=lambda channels: channels):
    path.parent.mkdir(exist_ok=True)
    write_raw(path.with_name("0.exr"), change(frame_channels(number, SIZE)))
    return path.with_name("0.exr").rename(path).parent


@pytest.fixture
def sequence(tmp_path):
    for number in (1, 2):
        write(tmp_path / "in" / f"seq.{number:04d}.exr", number)
    return tmp_path / "in"


def said(result, *words):
    """Status 2, and what is wrong: on stderr, or as a finding of ``stss check``."""
    if result.stdout:
        result = subprocess.CompletedProcess((), result.returncode, "", f"stss: {result.stdout.splitlines()[0]}")
    refused(result, *words)


# Numbers


@pytest.fixture
def apart(tmp_path):
    """Frames 1 and 99999999; outputs and truth of the same numbers."""
    for number in (1, FAR):
        write(tmp_path / "in" / f"seq.{number}.exr")
        for folder in ("out", "truth"):
            (tmp_path / folder).mkdir(exist_ok=True)
            write_rgb(tmp_path / folder / f"frame.{number}.png", np.zeros((2 * SIZE[0], 2 * SIZE[1], 3)))
    return tmp_path


GAP = f"no frame between 1 and {FAR}; expected gaps of at most 1000"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("check in", f"frames step by {FAR - 1}"),
        ("methods in truth -o new --rendered all --methods bilinear", GAP),
        ("flicker out truth --sequence in", "expected two frames in a row"),
        (f"run in -o new --frames 2:{FAR - 1} --keep-going", GAP),
    ],
)
def test_a_gap_between_frames_is_never_walked(apart, monkeypatch, command, words):
    monkeypatch.chdir(apart)
    plain = () if command.split()[0] in ("check", "flicker") else PLAIN
    said(call(*command.split(), *plain, seconds=20), words)
    assert not (apart / "new").exists()


def test_frames_apart_are_compared_all_the_same(apart):
    assert call("compare", apart / "out", apart / "truth", seconds=20).returncode == 0


def test_a_finding_lists_the_first_of_the_frames_that_are_not_there(apart):
    write(apart / "in" / "seq.3.exr")
    said(call("check", apart / "in", seconds=20), "display frames 2, 4, 5, 6, 7, 8, 9, 10, ... (99999996 in all)")


HUGE = "9" * 5000
LIMITED = hasattr(sys, "get_int_max_str_digits")
"""Whether this Python refuses numbers with so many digits by itself: 3.11, and late versions of 3.10."""


@pytest.mark.parametrize(
    ("command", "option", "values"),
    [
        ("run in -o new", "--frames", ["1", "2:1", f"1:{HUGE}", "1:1234567890", "-1:2", "a:b", "²:3", "nan:nan"]),
        ("run in -o new", "--metallic", ["nan", "inf", "-0.1", "1.1", "1e400", "x"]),
        ("run in -o new", "--roughness", ["nan", "-inf"]),
        ("run in -o new", "--memory-limit", ["0", "-1", "1e30", "1" + "0" * 30, HUGE, "nan"]),
        ("run in -o new", "--budget", ["nan", "inf", "0", "-1ms", "1e400", "x"]),
        ("check in", "--frames", [f"{HUGE}:{HUGE}"]),
        ("compare in in", "--frames", [f"1:{HUGE}"]),
        ("flicker in in --sequence in", "--frames", [f"1:{HUGE}"]),
        ("bench", "--size", ["99999x99999", f"1x{HUGE}"]),
        ("bench", "--repeat", ["0", HUGE, "1" + "0" * 30]),
        ("bench", "--frames", ["9", "1" + "0" * 30]),
        ("export default -o x.onnx", "--size", ["0x0", "16392x8"]),
        ("tune", "--size", [HUGE]),
        ("weights inspect default", "--size", ["0 8", "-8 8", "8 99999", f"8 {HUGE}"]),
        ("conform --exec true", "--seed", ["-1", "4294967296", HUGE]),
        ("conform --exec true", "--timeout", ["nan", "inf", "0", "-1", "1e30"]),
    ],
)
def test_an_option_out_of_its_range_is_refused(sequence, monkeypatch, command, option, values):
    monkeypatch.chdir(sequence.parent)
    for value in values:
        said(call(*command.split(), option, *value.split()), option)
        assert not (sequence.parent / "new").exists()


# TOML


TOML = {
    "5000 digits": (
        "units_per_cm = 1",
        f"units_per_cm = {'9' * 5000}",
        "cannot be read as TOML" if LIMITED else "found a whole number of",
    ),
    "nested lists": ("units_per_cm = 1", f"units_per_cm = {'[' * 5000}{']' * 5000}", "nested too deeply"),
    "nested tables": ("units_per_cm = 1", f"units_per_cm = {'{a=' * 3000}1{'}' * 3000}", "nested too deeply"),
    "dotted keys": ("units_per_cm = 1", f"units_per_cm.{'a.' * 5000}a = 1", "expected at most 200 dots in a line"),
    "a control character": ('name = "stss"', 'name = "\\u001b[2J"', "name: expected one line of text"),
    "control characters as a key": ("units_per_cm = 1", 'units_per_cm = 1\n"\\u001b[2J\\n" = 1', "\\x1b[2J\\n: unknown key"),
    "too large": ("units_per_cm = 1", "units_per_cm = 1 #" + 70000 * "x", "expected at most 64 KiB, found more"),
}


# Names


@pytest.mark.parametrize("command", ["check", "run -o new", "compare", "flicker"])
def test_a_file_whose_name_is_not_utf8_is_refused(sequence, monkeypatch, command):
    monkeypatch.chdir(sequence.parent)
    (sequence / "seq.0002.exr").rename(sequence / os.fsdecode(b"seq.\xff.0002.exr"))
    (sequence / "seq.0001.exr").unlink()
    more = {"compare": [sequence], "flicker": [sequence, "--sequence", sequence]}.get(command, [])
    said(call(*command.split(), sequence, *more), "seq.\\udcff.0002.exr: expected a name in UTF-8")


def test_names_with_control_characters_are_shown_escaped(tmp_path):
    folder = write(tmp_path / "a\n\x1b[2J" / "b\r\x07.0001.exr")
    refused(call("run", folder, "-o", tmp_path / "out", "--frames", "5:5", *PLAIN), "a\\n\\x1b[2J")
    refused(call("check", tmp_path, "--profile", "\x1b]0;title\x07"), "\\x1b]0;title\\x07")
    said(call("check", "nowhere\n\x1b[2J"), "nowhere\\n\\x1b[2J: expected a folder")
    result = call("check", folder)
    assert all(line.isprintable() for line in result.stdout.splitlines())


# Channels and metadata


# Files that are none


def special(path, kind):
    path.parent.mkdir(exist_ok=True)
    if kind == "a folder":
        path.mkdir()
    else:
        os.mkfifo(path)
    return path


PLACES = {
    "frames": ("in/seq.0003.exr", "check in"),
    "frames run": ("in/seq.0003.exr", "run in -o new"),
    "camera": ("special.csv", "run in -o new --camera special.csv"),
    "profile": ("special.toml", "run in -o new --profile special.toml"),
    "weights": ("special.safetensors", "run in -o new --weights special.safetensors"),
    "checkpoint": ("special.pkl", "weights import special.pkl -o new.safetensors"),
    "compared": ("truth/frame.0001.png", "compare in truth"),
    "known failures": ("special", "conform --port stss.port:ReferencePort --stages rrm --known-failures special"),
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", ["a folder", "a pipe"])
def test_only_regular_files_are_read(sequence, monkeypatch, place, kind):
    monkeypatch.chdir(sequence.parent)
    name, command = PLACES[place]
    special(sequence.parent / name, kind)
    said(call(*command.split(), seconds=20), name, f"expected a regular file, found {kind}")
    assert not (sequence.parent / "new").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[" * 100000, "expected JSON"),
        (b"[]", "expected format 1 and failures"),
        (b'{"format": 1, "failures": [7]}', "failures[0]: expected test, until and reason"),
        (b'{"format": 1, "failures": [{"test": "warp.\\u001b[2J", "until": 1}]}', "until: expected words, got '1'"),
        (b'{"format": 1, "failures": [{"test": "no.such", "until": "2999-01-01", "reason": "x"}]}', "no such test: no.such"),
        (b'{"format": 1, "failures": [{"test": "\\u0000.\\u001b", "until": "2999-01-01", "reason": "x"}]}', "no such test: "),
    ],
)
def test_a_hostile_list_of_known_failures_is_one_line(tmp_path, monkeypatch, content, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "known").write_bytes(content)
    refused(call("conform", "--port", "stss.port:ReferencePort", "--stages", "rrm", "--known-failures", "known"), words)


def test_an_unreadable_folder_is_one_line(tmp_path):
    if os.geteuid() != 0:
        pytest.skip("needs root, to become nobody")
    folder = write(tmp_path / "in" / "a.0001.exr")
    folder.chmod(0)
    os.seteuid(65534)
    try:
        with pytest.raises(InputError, match="cannot be read: Permission denied"):
            open_sequence(folder, "stss")
    finally:
        os.seteuid(0)
