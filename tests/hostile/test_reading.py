"""Inputs of ``stss``: numbers, names and files that no renderer writes; each is refused in one line, at once."""

import os
import struct
import subprocess
import sys

import numpy as np
import pytest

from stss.images.exr_header import header_bytes
from stss.images.read_write import write_rgb
from stss.sequence.reader import open_sequence
from stss_ground.errors import InputError
from tests.app.conftest import PLAIN, frame_channels, write_parts, write_raw
from tests.hostile.cases import call, refused, stss, unprivileged

SIZE = (8, 16)
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


def require_line(result, *words):
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
        (f"run in -o new --frames 2:{FAR - 1} --keep-going", GAP),
    ],
)
def test_a_gap_between_frames_is_never_walked(apart, monkeypatch, command, words):
    monkeypatch.chdir(apart)
    plain = () if command.split()[0] == "check" else PLAIN
    require_line(call(*command.split(), *plain, seconds=20), words)
    assert not (apart / "new").exists()


def test_frames_apart_are_compared_all_the_same(apart):
    assert call("compare", apart / "out", apart / "truth", seconds=20).returncode == 0


def test_a_finding_lists_the_first_of_the_frames_that_are_not_there(apart):
    write(apart / "in" / "seq.3.exr")
    require_line(call("check", apart / "in", seconds=20), "display frames 2, 4, 5, 6, 7, 8, 9, 10, ... (99999996 in all)")


@pytest.mark.parametrize(
    ("command", "option", "values"),
    [
        ("run in -o new", "--frames", ["1", "2:1", "1:1234567890", "-1:2", "a:b", "²:3", "nan:nan"]),
        ("run in -o new", "--metallic", ["nan", "inf", "-0.1", "1.1", "1e400", "x"]),
        ("run in -o new", "--roughness", ["nan", "-inf"]),
        ("run in -o new", "--memory-limit", ["0", "-1", "1e30", "nan"]),
        ("bench", "--size", ["99999x99999"]),
        ("bench", "--repeat", ["0"]),
        ("bench", "--frames", ["9"]),
        ("export realtime -o x.onnx", "--size", ["0x0", "16392x8"]),
        ("weights inspect realtime", "--size", ["0x8", "-8x8", "99999x8"]),
        ("conform --exec true", "--seed", ["-1", "4294967296"]),
        ("conform --exec true", "--timeout", ["nan", "inf", "0", "-1", "1e30"]),
    ],
)
def test_an_option_out_of_its_range_is_refused(sequence, monkeypatch, command, option, values):
    monkeypatch.chdir(sequence.parent)
    for value in values:
        require_line(call(*command.split(), option, *value.split()), option)
        assert not (sequence.parent / "new").exists()


# Names


@pytest.mark.parametrize("command", ["check", "run -o new", "compare", "compare --sequence"])
def test_a_file_whose_name_is_not_utf8_is_refused(sequence, monkeypatch, command):
    monkeypatch.chdir(sequence.parent)
    (sequence / "seq.0002.exr").rename(sequence / os.fsdecode(b"seq.\xff.0002.exr"))
    (sequence / "seq.0001.exr").unlink()
    more = {"compare": [sequence], "compare --sequence": [sequence, sequence]}.get(command, [])
    require_line(call(*command.split(), sequence, *more), "seq.\\udcff.0002.exr: expected a name in UTF-8")


OLD_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
"""A farm's, where Python does not take names for UTF-8; the files' names are in UTF-8."""


def test_a_name_with_accents_in_an_old_locale(sequence):
    """Python's library reads it. The command, whose reports are in UTF-8, says what to set."""
    folder = sequence.rename(sequence.parent / "été")
    refused(stss("check", folder, env=OLD_LOCALE), "expected a name in UTF-8; names here are ascii: set PYTHONUTF8=1")
    assert stss("check", folder, env=OLD_LOCALE | {"PYTHONUTF8": "1"}).stdout.endswith("\n")
    code = f"import os, stss; print(stss.open_sequence(os.fsdecode({os.fsencode(folder)})).numbers)"
    environment = {**os.environ, **OLD_LOCALE}
    process = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert process.stdout == "(1, 2)\n", process.stderr


# Files that are none


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
def test_only_regular_files_are_read(sequence, monkeypatch, place):
    monkeypatch.chdir(sequence.parent)
    name, command = PLACES[place]
    (sequence.parent / name).mkdir(parents=True)
    require_line(call(*command.split(), seconds=20), name, "expected a regular file, found a folder")
    assert not (sequence.parent / "new").exists()


def test_an_unreadable_folder_is_one_line(tmp_path):
    if os.geteuid() != 0:
        pytest.skip("needs root, to become nobody")
    folder = write(tmp_path / "in" / "a.0001.exr")
    folder.chmod(0)
    with unprivileged(), pytest.raises(InputError, match="cannot be read: Permission denied"):
        open_sequence(folder, "stss")


@pytest.mark.parametrize("kind", ["string", "floatvector", "unknown"])
def test_an_attribute_as_long_as_its_file_is_not_read(sequence, kind):
    """3 GiB of zeros that take no place on the disk; OpenEXR would take as much memory."""
    path = sequence / "seq.0002.exr"
    data = path.read_bytes()
    with path.open("wb") as file:
        file.write(data[:8] + b"long\0" + kind.encode() + b"\0" + struct.pack("<I", 3 << 30))
        file.truncate(3 << 30)
    require_line(call("check", sequence, seconds=20), "seq.0002.exr: a header of more than 32 MiB")


def test_a_header_is_measured_in_files_of_every_kind(tmp_path):
    """Of one part and of several, up to the last attribute."""
    size = 4 * len("a comment")
    for parts in (1, 3):
        path, attributes = tmp_path / f"{parts}.exr", {"comment": ("a comment" * 4,)}
        write_parts(path, *(((np.zeros((4, 4, 1), np.float32)), ["Y"], attributes) for _ in range(parts)))
        with path.open("rb") as file:
            file.seek(4)
            assert size * parts < header_bytes(file) < 1000 * parts


def test_a_header_that_claims_more_than_the_file_can_hold(sequence):
    """Refused before memory is taken: 16384 x 16384 of 19 channels are 19 GiB."""
    path = sequence / "seq.0002.exr"
    for side in (4000, 16384, 2**31 - 1):
        window = struct.pack("<4i", 0, 0, SIZE[1] - 1, SIZE[0] - 1)
        path.write_bytes(path.read_bytes().replace(window, struct.pack("<4i", 0, 0, side - 1, side - 1)))
        require_line(call("check", sequence, seconds=20), "seq.0002.exr: ")
        write(path, 2)
