# SPDX-License-Identifier: MIT
"""`stss compare`: an output folder against a folder of truth (spec section 9)."""

from __future__ import annotations

import io
import json
import math
import struct

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
from rich.console import Console

from stss.images.color import REC709, transfer
from stss.images.encode import encode_exr
from stss.images.read_write import write_mask, write_rgb
from stss.images.windows import PixelWindow
from stss.quality.compare import compare, facts, print_comparison
from stss_ground.errors import InputError
from tests.app.conftest import write_raw
from tests.hostile.cases import call, refused

SIZE = (24, 32)
LEVEL = 1 / 255


@pytest.fixture
def out(tmp_path):
    (tmp_path / "out" / "holes").mkdir(parents=True)
    return tmp_path / "out"


@pytest.fixture
def truth(tmp_path):
    (tmp_path / "truth").mkdir()
    return tmp_path / "truth"


def flat(level, size=SIZE):
    """A grey PNG image of this 8-bit level."""
    return np.full((*size, 3), level * LEVEL, np.float32)


def labels(kind, transfer="srgb"):
    return {"stss:kind": kind, "stss:transfer": transfer, "stss:weights": "arena", "stss:backend": "ref"}


def write_pair(out, truth, number, kind, off):
    """An output that is `off` levels brighter than its truth; an EF's upper left quarter is a hole."""
    write_rgb(out / f"frame.{number:04d}.png", flat(100 + off), metadata=labels(kind) if kind else None)
    write_rgb(truth / f"shot.{number:04d}.png", flat(100))
    if kind == "EF":
        hole = np.zeros((SIZE[0] // 2, SIZE[1] // 2), np.bool_)
        hole[: SIZE[0] // 4, : SIZE[1] // 4] = True
        write_mask(out / "holes" / f"frame.{number:04d}.png", hole)


def decibels(off):
    return 20 * math.log10(255 / off)


def near(value, expected):
    """Equal but for the last digits of float64 arithmetic on numbers below 100."""
    return abs(value - expected) < 1e-10


def test_known_differences_give_known_scores(out, truth):
    """SF off by 1 and 2 levels, EF by 4: the means are of decibels, MEAN is the mean of the kinds' means."""
    write_pair(out, truth, 2, "SF", 1)
    write_pair(out, truth, 3, "EF", 4)
    write_pair(out, truth, 4, "SF", 2)
    comparison = compare(out, truth)
    assert [(r.number, r.kind) for r in comparison.rows] == [(2, "SF"), (3, "EF"), (4, "SF")]
    assert [(m.name, m.frames) for m in comparison.means] == [("SF", 2), ("EF", 1), ("MEAN", 3)]
    sf, ef, mean = (m.scores["all"].psnr_rgb for m in comparison.means)
    assert near(sf, (decibels(1) + decibels(2)) / 2)
    assert near(ef, decibels(4))
    assert near(mean, (sf + ef) / 2)
    assert near(comparison.means[1].scores["holes"].psnr_rgb, decibels(4))
    assert near(comparison.means[1].scores["all"].psnr_luma, decibels(4 * 219 / 255))
    assert comparison.means[0].scores["holes"].psnr_rgb is None
    assert comparison.means[2].scores["holes"].psnr_rgb is None
    assert comparison.means[0].scores["edges"].psnr_rgb is None  # a flat truth has no edges
    assert comparison.notes == []
    assert comparison.made_with == {"weights": ["arena"], "backend": ["ref"], "transfer": ["srgb"]}


def test_tpsnr_is_of_the_change(out, truth):
    """Off by 1, 3 and 3 levels: the change is off by 2, then by nothing. After a missing frame there is no change to judge."""
    for number, off in ((1, 1), (2, 3), (3, 3), (5, 5)):
        write_pair(out, truth, number, "EF" if number % 2 else "SF", off)
    comparison = compare(out, truth)
    changes = [row.scores["all"].tpsnr for row in comparison.rows]
    assert changes[0] is None
    assert abs(changes[1] - decibels(2)) < 1e-4  # levels of a PNG are read as float32
    assert changes[2] == math.inf or changes[2] > 140
    assert changes[3] is None
    assert comparison.rows[1].scores["edges"].tpsnr is None


@pytest.mark.parametrize(("shift", "word"), [(1, "after"), (-1, "before"), (0, None)])
def test_numbers_that_are_one_off_are_told(out, truth, shift, word):
    """The scores alone would say that the method is bad."""
    for number in range(4):
        write_rgb(truth / f"frame.{number:04d}.png", flat(100 + 10 * number))
        write_rgb(out / f"frame.{number:04d}.png", flat(102 + 10 * (number + shift)), metadata=labels("SF"))
    told = [note for note in compare(out, truth).notes if "twice as near to the truth of the frame" in note]
    assert [f"the frame {word}" in note for note in told] == ([] if word is None else [True])


def test_the_holes_of_static_surfaces_are_a_mean(out, truth):
    for number, share in ((1, "0.1"), (2, None), (3, "0.5")):
        write_pair(out, truth, number, "EF", 0)
        more = {} if share is None else {"stss:static-holes": share}
        write_rgb(out / f"frame.{number:04d}.png", flat(100), metadata={**labels("EF"), **more})
    comparison = compare(out, truth)
    assert json.loads(comparison.to_json())["static_holes"] == comparison.static_holes == 0.3
    assert "holes: 30.0% of the static surfaces of EFs" in facts(comparison)


def test_holes_are_those_of_another_run_where_it_is_named(out, truth, tmp_path):
    """The scored errors depend on the mask, so the report states its share; a frame without a mask there is not scored."""
    for number, off in ((1, 4), (3, 4)):
        write_pair(out, truth, number, "EF", off)
    image = np.array(flat(100))
    image[: SIZE[0] // 2] = 104 * LEVEL
    write_rgb(out / "frame.0001.png", image, metadata=labels("EF"))
    (tmp_path / "other" / "holes").mkdir(parents=True)
    low = np.zeros((SIZE[0] // 2, SIZE[1] // 2), np.bool_)
    low[SIZE[0] // 4 :] = True
    write_mask(tmp_path / "other" / "holes" / "frame.0001.png", low)
    own, other = compare(out, truth), compare(out, truth, holes=tmp_path / "other")
    assert near(own.rows[0].scores["holes"].psnr_rgb, decibels(4))
    assert other.rows[0].scores["holes"].psnr_rgb == math.inf
    assert other.rows[1].scores["holes"].psnr_rgb is None
    share = other.rows[0].hole
    assert 0.4 < share <= 0.5
    assert f"holes are scored over {share:.1%} of the pixels" in facts(other)
    assert json.loads(other.to_json())["holes"] == share
    assert any("other/holes: no holes of frame 3; not scored there" in line for line in facts(other))
    assert call("compare", out, truth, "--holes", tmp_path / "other").stdout.count(f"over {share:.1%}") == 1


@pytest.mark.parametrize("name", ["none", "srgb"])
def test_exr_and_png_are_judged_alike(out, truth, name):
    """EXR in the renderer's domain against PNG of the same frame, either way round: nothing is wrong but rounding."""
    rng = np.random.default_rng(5)
    color = rng.random((*SIZE, 3), dtype=np.float32) * (1 if name == "none" else 2)
    write_rgb(out / "frame.0001.exr", color, metadata=labels("SF", name))
    write_rgb(truth / "frame.0001.png", transfer(name).display(color))
    # One level (a PNG is rounded, an EXR cut off) everywhere would be 48.1 dB. Half of the pixels have it.
    assert compare(out, truth).rows[0].scores["all"].psnr_rgb > decibels(1)
    write_rgb(truth / "frame.0001.exr", color)
    (truth / "frame.0001.png").unlink()
    assert compare(out, truth).rows[0].scores["all"].psnr_rgb == math.inf


@pytest.mark.parametrize("side", ["out", "truth"])
def test_values_that_are_not_finite_are_refused(out, truth, side):
    bad = np.full((*SIZE, 3), 0.5, np.float32)
    bad[3, 4, 1] = np.nan
    bad[5, 6] = np.inf
    for folder in (out, truth):
        image = bad if folder.name == side else np.nan_to_num(bad, nan=0.0, posinf=0.0)
        write_raw(folder / "frame.0001.exr", {name: image[..., i] for i, name in enumerate("RGB")})
    message = rf"{side}/frame\.0001\.exr: 4 non-finite values, first in G at \(y=3, x=4\); --non-finite mask takes them as 0"
    with pytest.raises(InputError, match=message):
        compare(out, truth)
    assert compare(out, truth, non_finite="mask").rows[0].scores["all"].psnr_rgb == math.inf
    refused(call("compare", out, truth), "4 non-finite values")
    assert call("compare", out, truth, "--non-finite", "mask").returncode == 0


def test_other_primaries_are_named(out, truth):
    """Colours are compared as they are; a file without the attribute has those of Rec. 709."""
    image = {name: np.full(SIZE, 0.5) for name in "RGB"}
    wide = 0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329
    primaries = (None, wide, wide, (*REC709[:-1], 0.3290001))
    for number, (ours, theirs) in enumerate(zip(primaries, (wide, wide, None, None), strict=True)):
        for folder, chromaticities in ((out, ours), (truth, theirs)):
            pixels = np.stack([*image.values()], axis=-1).astype(np.float32)
            metadata = {"stss:kind": "SF"} | ({} if chromaticities is None else {"chromaticities": chromaticities})
            path = folder / f"frame.{number:04d}.exr"
            path.write_bytes(encode_exr(path, ("R", "G", "B"), pixels, (), metadata))
    notes = [line for line in facts(compare(out, truth)) if "chromaticities" in line]
    assert len(notes) == 1
    assert notes[0].startswith(
        "chromaticities of frames 0, 2: 0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329 in the output, 0.708, "
    )
    assert notes[0].endswith("in the truth; not converted")


def profile(name):
    """The least ICC profile of RGB that has this name."""
    text = name.encode("utf-16-be")
    description = b"mluc" + struct.pack(">3I4s2I", 0, 1, 12, b"enUS", len(text), 28) + text + b"\0\0" * (len(name) % 2)
    head = struct.pack(">I4sI4s4s4s12s4s", 144 + len(description), b"none", 4 << 24, b"mntr", b"RGB ", b"XYZ ", b"", b"acsp")
    return np.frombuffer(
        head.ljust(128, b"\0") + struct.pack(">I4s2I", 1, b"desc", 144, len(description)) + description, np.uint8
    )


@pytest.mark.parametrize(
    ("suffix", "tag", "words"),
    [
        (".exr", {"colorInteropID": "lin_rec709_scene"}, None),
        (".exr", {"colorInteropID": "lin_ap1_scene"}, "lin_ap1_scene"),
        (".exr", {"colorInteropID": "srgb_rec709_scene"}, "srgb_rec709_scene"),
        (".png", {}, None),
        (".png", {"oiio:ColorSpace": "srgb_rec709_scene"}, None),
        (".png", {"oiio:ColorSpace": "lin_rec709_scene"}, "lin_rec709_scene"),
        (".png", {"CICP": (9, 16, 0, 1)}, "pq_rec2020_display"),
        (".png", {"ICCProfile": profile("Display P3")}, "Display P3"),
        (".png", {"ICCProfile": profile("sRGB IEC61966-2.1")}, None),
    ],
)
def test_colours_of_another_space_are_named(out, truth, suffix, tag, words):
    """Of an EXR, which is linear as a rule, and of a PNG, which is sRGB; they are compared as they are."""
    write_rgb(out / "frame.0000.exr", np.full((*SIZE, 3), 0.5, np.float32), metadata=labels("SF"))
    image = oiio.ImageBuf(flat(100))
    for name, value in tag.items():
        kind = {tuple: "int[4]", str: "string", np.ndarray: f"uint8[{len(value)}]"}[type(value)]
        image.specmod().attribute(name, kind, value)
    assert image.write(str(truth / f"shot.0000{suffix}"), "uint8" if suffix == ".png" else "half")
    notes = [line for line in facts(compare(out, truth)) if line.startswith("colours of")]
    assert notes == (
        [] if words is None else [f"colours of frame 0: linear Rec. 709 in the output, {words} in the truth; not converted"]
    )


def test_a_truth_that_is_cropped_is_named(out, truth):
    """A region of a render: the rest counts as black. Overscan does not."""
    pixels = np.full((*SIZE, 3), 0.5, np.float32)
    display = PixelWindow(0, 0, SIZE[1], SIZE[0])
    for number, (x, y) in enumerate([(0, 0), (2, 1), (-2, -1)]):
        write_rgb(out / f"frame.{number:04d}.exr", pixels, metadata=labels("SF"))
        data = PixelWindow(x, y, SIZE[1] - 2 * x, SIZE[0] - 2 * y)
        path = truth / f"shot.{number:04d}.exr"
        path.write_bytes(encode_exr(path, ("R", "G", "B"), np.full((*data.size, 3), 0.5, np.float32), (), {}, (data, display)))
    notes = [line for line in facts(compare(out, truth)) if "data windows" in line]
    assert notes == [
        "data windows of frame 1: (0, 0) - (31, 23) in the output, (2, 1) - (29, 22) in the truth; black outside of them"
    ]


def test_frames_without_partner_are_listed(out, truth):
    """Nothing is dropped in silence; a range limits both folders."""
    for number in range(1, 7):
        write_pair(out, truth, number, "SF", 1)
    (truth / "shot.0001.png").unlink()
    (out / "frame.0006.png").unlink()
    comparison = compare(out, truth)
    assert (comparison.without_truth, comparison.without_output) == ([1], [6])
    comparison = compare(out, truth, frames=(3, 6))
    assert [r.number for r in comparison.rows] == [3, 4, 5]
    assert (comparison.without_truth, comparison.without_output) == ([], [6])


def test_somebody_else_s_output_is_one_group(out, truth):
    """No labels: one mean over all, and the reader is told."""
    write_pair(out, truth, 1, None, 1)
    write_rgb(out / "frame.0002.exr", np.zeros((*SIZE, 3), np.float32))
    write_rgb(truth / "shot.0002.png", flat(0))
    comparison = compare(out, truth)
    assert [(m.name, m.frames) for m in comparison.means] == [("all", 2)]
    assert [note.partition(": ")[2] for note in comparison.notes] == [
        "kinds of frame are not known (no stss:kind); means are over all frames",
        "no transfer named (no stss:transfer); EXR is taken as scene-linear and shown as srgb",
        "no holes of frames 1 to 2; not scored there",
    ]
    assert comparison.rows[0].scores["holes"].psnr_luma is None


def test_other_kinds_of_image_are_named(out, truth):
    write_rgb(out / "frame.0001.png", flat(100))
    (truth / "shot.0001.jpg").touch()
    with pytest.raises(InputError, match=r"truth: no frames; expected .* NAME\.0001\.png; found \.jpg$"):
        compare(out, truth)


def test_json_is_valid_and_says_infinite(out, truth):
    """No NaN or Infinity, which JSON lacks: "inf" and null."""
    write_pair(out, truth, 3, "EF", 0)
    text = compare(out, truth).to_json()
    data = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    frame = data["frames"][0]
    assert [frame[name] for name in ("frame", "kind", "output", "truth")] == [3, "EF", "frame.0003.png", "shot.0003.png"]
    assert frame["all"] == {"psnr_luma": "inf", "ssim": 1, "psnr_rgb": "inf", "tpsnr": None}
    assert frame["edges"] == {"psnr_luma": None, "ssim": None, "psnr_rgb": None}
    assert data["means"]["EF"]["frames"] == 1


def test_what_does_not_fit_is_named(out, truth):
    """Sizes of truth and of holes, with both files and both sizes."""
    write_pair(out, truth, 3, "EF", 1)
    write_rgb(truth / "shot.0003.png", flat(100, (12, 16)))
    with pytest.raises(InputError, match=r"shot\.0003\.png: expected 32 x 24 .*frame\.0003\.png, found 16 x 12"):
        compare(out, truth)
    write_rgb(truth / "shot.0003.png", flat(100))
    write_mask(out / "holes" / "frame.0003.png", np.zeros(SIZE, np.bool_))
    with pytest.raises(InputError, match=r"holes/frame\.0003\.png: expected 16 x 12 .*, found 32 x 24"):
        compare(out, truth)


def test_folders_that_do_not_fit(out, truth, tmp_path):
    """Not there, empty, without a common frame, with a frame twice."""
    with pytest.raises(InputError, match="nowhere: no such folder"):
        compare(tmp_path / "nowhere", truth)
    write_pair(out, truth, 3, "SF", 1)
    with pytest.raises(InputError, match="found no frames within 7 to 9"):
        compare(out, truth, frames=(7, 9))
    (truth / "shot.0003.png").rename(truth / "shot.0004.png")
    with pytest.raises(InputError, match=r"one of frame 3; found frame 4$"):
        compare(out, truth)
    write_rgb(truth / "other.0004.png", flat(1))
    with pytest.raises(InputError, match=r"frame 4 appears twice: other\.0004\.png, shot\.0004\.png; give one as a pattern"):
        compare(out, truth)


def test_a_pattern_says_which_of_a_folder_s_sequences_is_meant(out, truth):
    """A renderer that writes a file for each pass puts them beside its picture."""
    for number in (3, 4):
        write_pair(out, truth, number, "SF", 1)
        for name in (f"shot.{number:04d}_L2.png", f"shot_depth.{number:04d}.png"):
            write_rgb(truth / name, flat(140))
    for pattern, off in (("shot.####.png", 1), ("shot.####_L2", 39)):
        rows = compare(out / "frame.####.png", truth / pattern).rows
        assert len(rows) == 2
        assert near(rows[0].scores["all"].psnr_rgb, decibels(off))
    assert len(compare(out, truth / "shot.####", frames=(4, 4)).rows) == 1
    for wrong in ("shot.####.exr", "sho.####.png", "shot_####.png"):
        with pytest.raises(InputError, match=rf"{wrong}: no frames$"):
            compare(out, truth / wrong)


@pytest.mark.parametrize(
    ("label", "value", "message"),
    [
        ("stss:kind", "IF", "expected SF or EF, found 'IF'"),
        ("stss:transfer", "pq", "expected one of none, srgb, found 'pq'"),
        ("stss:static-holes", "half", "expected a number from 0 to 1, found 'half'"),
    ],
)
def test_wrong_labels_are_named(out, truth, label, value, message):
    """A label that stss never writes is a mistake, not a new kind."""
    write_pair(out, truth, 3, "SF", 1)
    write_rgb(out / "frame.0003.png", flat(1), metadata={**labels("SF"), label: value})
    with pytest.raises(InputError, match=rf"frame\.0003\.png: {label}: {message}"):
        compare(out, truth)
    write_rgb(out / "frame.0003.png", flat(1), metadata=labels("SF"))
    write_pair(out, truth, 4, None, 1)
    with pytest.raises(InputError, match="frame 4 without stss:kind"):  # means over a mixture would be meaningless
        compare(out, truth)


def test_the_table_holds_every_frame_and_note(out, truth):
    """80 columns wide, plain text when not a terminal."""
    for number, kind in ((2, "SF"), (3, "EF"), (1004, "SF")):
        write_pair(out, truth, number, kind, number % 10)
    (truth / "shot.1004.png").unlink()
    console = Console(file=io.StringIO(), width=80)
    print_comparison(compare(out, truth), console)
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    table = {tuple(line.split()[:2]): line.split() for line in lines if len(line.split()) == 11}
    means = {line.split()[2]: line.split() for line in lines if line.strip().startswith("of ")}
    # SSIM of flat luma: 1 - (a - b)^2 / (a^2 + b^2 + C1), a and b 101.9 and 104.5.
    assert table["3", "EF"][2:] == ["39.91", "-", "39.91", "0.9997", "-", "0.9997", "38.59", "-", "38.59"]
    assert means["MEAN"][9] == f"{(decibels(2) + decibels(3)) / 2:.2f}"
    assert lines[-1] == "not compared, no truth: frame 1004"
