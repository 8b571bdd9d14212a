"""Frame numbers in the names of files: signs, fractions, patterns, names with unusual characters."""

import errno
import os
import unicodedata
from pathlib import Path

import numpy as np
import pytest

from stss.images.read_write import read_rgb, write_channels, write_rgb
from stss.quality.output_and_truth import find_pairs
from stss.sequence.find_files import find_frames, numbered_files
from stss_ground.errors import InputError
from tests.app.conftest import PLAIN
from tests.hostile.cases import call


def find_names(folder, *names, path=None):
    """Frame number -> name, of empty files."""
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / f"{name}.exr").touch()
    return {number: files[""].stem for number, files in find_frames(path or folder, {""}).items()}


def test_a_pattern_that_finds_nothing_names_what_is_there(tmp_path):
    with pytest.raises(
        InputError, match=r"t\.####\.exr: no frames; expected files named like NAME\.0001\.exr; found s\.0001\.exr$"
    ):
        find_names(tmp_path / "in", "s.0002", "s.0001", path=tmp_path / "in" / "t.####.exr")


@pytest.mark.parametrize(
    "names",
    [
        {-6: "shot.-0006", -1: "shot.-0001", 0: "shot.0000", 1: "shot.0001"},
        {-6: "shot_-006", -1: "shot_-001"},
        {-6: "shot -6", 5: "shot 5"},
        {-6: "shot--0006", 1: "shot-0001"},
        {-6: "shot-006", 0: "shot0000", 12: "shot0012"},
        {-6: "-0006", -1: "-0001", 0: "0000"},
        {6: "shot-0006", 1: "shot-0001"},
        {6: "sh010-0006", 1: "sh010-0001"},
        {26: "2026-11-26", 27: "2026-11-27"},
    ],
    ids=str,
)
def test_a_minus_sign_is_told_from_a_dash(tmp_path, names):
    assert find_names(tmp_path, *names.values()) == names


@pytest.mark.parametrize(("pattern", "advice"), [
    ("shot.%04d.exr", "shot.####.exr"), ("shot.$F4.exr", "shot.####.exr"), ("shot.<F4>.exr", "shot.####.exr"),
    ("shot_v002.@@@@.exr", "shot_v002.####.exr"), ("shot-2.*.exr", "shot-2.####.exr"), ("shot.[1-24].exr", "shot.####.exr"),
    ("shot.0001-0024.exr", "shot.####.exr"), ("shot_v002.0001.exr", "shot_v002.####.exr"), ("a1.%d.EXR", "a1.####.EXR"),
    ("shot01", None), ("shot", None),
])  # fmt: skip
def test_the_pattern_of_another_program_is_told_as_ours(tmp_path, pattern, advice):
    (tmp_path / "shot_v002.0001.exr").touch()
    with pytest.raises(InputError) as error:
        find_frames(tmp_path / pattern, [""])
    assert "expected a folder, or a pattern like name.####.exr; found " in str(error.value)
    assert str(error.value).partition("; write ")[2] == (advice or "")


def test_all_files_of_a_folder_are_the_folder(tmp_path):
    with pytest.raises(InputError) as error:
        find_frames(tmp_path / "*.exr", [""])
    assert str(error.value).endswith(f"found nothing; write {tmp_path}")


def test_a_name_that_windows_refuses_is_told_as_ours(tmp_path, monkeypatch):
    def refuse(folder):
        raise OSError(errno.EINVAL, "The filename is incorrect", str(folder))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(InputError, match=r"found nothing; write shot\.####\.exr"):
        find_frames(tmp_path / "shot.<F4>.exr", [""])


@pytest.mark.skipif(os.sep != "/", reason="a backslash is no letter of a name here")
def test_a_path_of_windows_is_told():
    with pytest.raises(InputError, match=r"found nothing; the path has \\, and folders are separated by / here"):
        find_frames(Path(r"shots\a\lr"), [""])


def test_a_folder_of_pictures_is_told(tmp_path):
    (tmp_path / "seq.0001.png").touch()
    with pytest.raises(
        InputError, match=r"no frames; .*; \.png hold colour alone, and stss needs motion, depth and more: write Open"
    ):
        find_frames(tmp_path, [""])


def test_a_folder_of_folders_is_told(tmp_path):
    """One for each frame, as some farms leave them, or the folder above."""
    for name in ("0001", "0002", "0003"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "beauty.exr").touch()
    with pytest.raises(InputError, match=r"no frames; .*; its folder 0001 has EXR files: give that one, or put all frames"):
        find_frames(tmp_path, [""])


def test_a_folder_for_each_pass_is_told(tmp_path):
    """As compositors' nodes and render elements leave them."""
    for name in ("beauty", "depth", "normal"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "0001.exr").touch()
    with pytest.raises(
        InputError, match=r"; its folders beauty, depth, normal have frames of .*, beauty\.0001\.exr, and say --profile"
    ):
        find_frames(tmp_path, [""])
    (tmp_path / "depth" / "0001.exr").rename(tmp_path / "depth" / "0002.exr")
    with pytest.raises(InputError, match="; its folder beauty has EXR files"):
        find_frames(tmp_path, [""])


def test_of_the_folders_in_a_folder_the_one_with_buffers_is_told(write_frames, tmp_path):
    """And not the truth, whose name comes first."""
    write_frames([1], size=(16, 24), folder="lr")
    (tmp_path / "hr").mkdir()
    write_channels(tmp_path / "hr" / "a.0001.exr", {name: np.zeros((4, 4), np.float32) for name in "RGB"})
    with pytest.raises(InputError, match="; its folder lr has EXR files"):
        find_frames(tmp_path, [""])


def test_frames_before_zero_run_in_order(write_frames, tmp_path):
    """A pre-roll: the outputs have the pictures of a run whose numbers begin at 0, under the numbers of their inputs."""
    folder = write_frames(range(-6, 0), rendered={-6, -4, -2}, size=(16, 24))
    moved = tmp_path / "moved"
    moved.mkdir()
    for number in range(-6, 0):
        (moved / f"seq.{number + 6:04d}.exr").write_bytes((folder / f"seq.{number:04d}.exr").read_bytes())
    for source, out in ((folder, "a"), (moved, "b")):
        assert not call("run", source, "-o", tmp_path / out, *PLAIN).returncode
    pairs = {n: (tmp_path / "a" / f"frame.{n:04d}.exr", tmp_path / "b" / f"frame.{n + 6:04d}.exr") for n in range(-6, 0)}
    assert {p.name for p in (tmp_path / "a").glob("*.exr")} == {a.name for a, _ in pairs.values()}
    for a, b in pairs.values():
        np.testing.assert_array_equal(read_rgb(a), read_rgb(b))
    for some, more in ((range(-3, 0), ()), (range(-2, 0), ("--overwrite",))):
        part = "--frames", f"{some[0]}:{some[-1]}", "--cuts", "-4"
        assert not call("run", folder, "-o", tmp_path / "c", *PLAIN, *part, *more).returncode
        assert {p.name for p in (tmp_path / "c").glob("*.exr")} == {f"frame.{n:04d}.exr" for n in range(-3, 0)}


def test_frames_before_zero_are_compared(tmp_path):
    for folder, width in (("out", 4), ("truth", 3)):
        (tmp_path / folder).mkdir()
        for number in (-2, -1, 1):
            write_rgb(tmp_path / folder / f"frame.{number:0{width}d}.png", np.zeros((4, 4, 3)))
    pairs, *others = find_pairs(tmp_path / "out", tmp_path / "truth", (-2, 0))
    assert [pairs[n].truth.name for n in pairs] == ["frame.-02.png", "frame.-01.png"]
    assert others == [[], []]


def test_a_pattern_says_where_the_separators_are(tmp_path):
    eyes = [f"sh.000{n}_{eye}" for n in (1, 2) for eye in "LR"]
    assert find_names(tmp_path, *eyes, path=tmp_path / "sh.####_L.exr") == {1: "sh.0001_L", 2: "sh.0002_L"}
    twice = ["a.0001", "a_0001", "a_0002"]
    assert find_names(tmp_path, *twice, path=tmp_path / "a_####.exr") == {1: "a_0001", 2: "a_0002"}
    assert find_names(tmp_path, *twice, path=tmp_path / "a.####") == {1: "a.0001"}
    assert find_names(tmp_path, "b#c.0001", path=tmp_path / "b#c.#.exr") == {1: "b#c.0001"}


def test_a_pattern_says_which_number_is_the_frame(tmp_path):
    names = {n: f"sh_000{n}_v02.4k" for n in (1, 2)}
    assert find_names(tmp_path, *names.values(), "sh_0003_v01.4k", path=tmp_path / "sh_####_v02.4k.exr") == names
    with pytest.raises(InputError, match=r"v01\.####k\.exr \(1 frame\); give one as a pattern, with #### for the number$"):
        find_names(tmp_path)
    with pytest.raises(InputError, match=r", \.\.\. \(20 in all\); give .*; if 0000 is a frame's number, it is a1_####_v3\.exr$"):
        find_names(tmp_path / "late", *(f"a1_{n:04d}_v3" for n in range(20)))


def test_accents_are_written_in_two_ways(tmp_path):
    """A file system of macOS gives NFD where a keyboard gives NFC."""
    composed, parted = (unicodedata.normalize(form, "épée") for form in ("NFC", "NFD"))
    for name, other in ((composed, parted), (parted, composed)):
        folder = tmp_path / str(len(name))
        assert find_names(folder, f"{name}.0001", path=folder / f"{other}.#.exr") == {1: f"{name}.0001"}
        (folder / f"a {name}.0001.exr").touch()
        assert find_frames(folder / "a.#.exr", {other})[1][other].stem == f"a {name}.0001"


def test_a_folder_may_have_a_number_sign(tmp_path):
    assert find_names(tmp_path / "take #2", "a.0001") == {1: "a.0001"}
    assert find_names(tmp_path / "take #2", path=tmp_path / "take #2" / "a.#.exr") == {1: "a.0001"}


@pytest.mark.parametrize("pattern", ["", "shot.####.exr", "shot.####.#.exr"])
@pytest.mark.parametrize("names", [("0001.0", "0001.5", "0002.0", "0002.5"), ("1", "1.5", "2", "2.5")], ids=" ".join)
def test_fractions_are_named(tmp_path, names, pattern):
    if names[0] == "1" and pattern == "shot.####.exr":
        assert find_names(tmp_path, *(f"shot.{n}" for n in names), path=tmp_path / pattern) == {1: "shot.1", 2: "shot.2"}
        return
    with pytest.raises(InputError, match=rf"; {names[1]} looks like a fraction, .* by whole numbers, half frames too"):
        find_names(tmp_path, *(f"shot.{n}" for n in names), path=tmp_path / pattern)


def test_versions_are_no_fractions(tmp_path):
    with pytest.raises(InputError) as error:
        find_names(tmp_path, "shot_v1.0001", "shot_v2.0001")
    assert "looks like" not in str(error.value)


def test_a_long_number_is_refused_wherever_it_stands():
    with pytest.raises(InputError, match="at most 9 digits, found 10"):
        numbered_files([Path("a.-1234567890.exr")])
