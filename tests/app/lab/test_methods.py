# SPDX-License-Identifier: MIT
"""Display frames without a network: properties of each method, and their use by `stss methods`."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
from scipy.ndimage import binary_dilation

from stss.demo import write_demo_sequence
from stss.frames.backends import ReferenceBackend
from stss.frames.supersampler import Supersampler
from stss.images.read_write import write_rgb
from stss.images.resample import enlarge, lanczos_centres
from stss.run.job import run
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss.weights.file import BILINEAR, load
from stss_ground.errors import InputError
from stss_lab.baselines.fxaa import fxaa
from stss_lab.baselines.registry import METHODS, MethodBackend
from stss_lab.baselines.taau import Taau
from stss_lab.methods.methods_table import choose_methods, run_methods
from stss_ref.frame import FrameInputs, prepare
from stss_ref.resample import upsample_centres
from tests.app.conftest import frames_of
from tests.hostile.cases import call, refused

SF, EF = (0, 2, 4), (1, 3, 5)
H, W = 20, 28
MARGIN = 12
"""Pixels of the output; farther from the frame's edge no kernel and no motion of these tests reads beyond it."""


def texture(x, y):
    """(H, W, 3) in 0.1..0.9: a pattern on a plane, at these places of it."""
    waves = [np.sin(x / 2 + y / 5), np.cos(y / 3), np.sin(x / 4 - y / 2)]
    return (0.5 + 0.4 * np.stack(waves, axis=-1)).astype(np.float32)


def inputs(steps, colors, motion=(0.0, 0.0)):
    """A plane seen head-on that moves as a whole: no holes but where it comes into view."""
    moved = np.broadcast_to(np.float32(motion), (max(steps), H, W, 2))
    zeros = np.zeros((4, H, W, 3), np.float32)
    gbuffer = np.zeros((H, W, 9), np.float32)
    return FrameInputs(np.stack(colors), steps, moved, gbuffer, np.ones((H, W), np.float32), zeros[..., 0], zeros, zeros)


def slide(number, steps, motion):
    """Display frame ``number`` of the textured plane, whose surface was at ``p + motion`` a frame earlier."""
    y, x = np.indices((H, W))
    colors = [texture(x + motion[0] * (number - step), y + motion[1] * (number - step)) for step in steps]
    return inputs(steps, colors, motion)


def noise(seed=0):
    return np.random.default_rng(seed).random((H, W, 3), dtype=np.float32)


def inside(image):
    return image[MARGIN:-MARGIN, MARGIN:-MARGIN]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("motion", [(0.3, -1.6), (np.nan, 0.0)])
def test_one_colour_stays_one_colour(method, motion):
    """For any movement, and after many frames."""
    color = np.broadcast_to(np.float32([0.2, 0.5, 0.9]), (H, W, 3))
    backend = MethodBackend(method)
    for steps in (SF, EF) * 2:
        image, valid = backend.frame(inputs(steps, [color] * 3, motion))
        assert image.shape == (2 * H, 2 * W, 3)
        assert image.dtype == np.float32
        assert valid.shape == (H, W)
        # Lanczos's weights add up to 1 but for rounding, twice: 12 products and sums each.
        assert np.abs(image - color[0, 0]).max() <= (24 * 2**-23 if method == "lanczos" else 0)


@pytest.mark.parametrize("steps", [SF, EF])
def test_bilinear_is_the_network_without_its_residual(steps):
    window_now = slide(7, steps, (0.7, -0.4))
    image, valid = MethodBackend("bilinear").frame(window_now)
    expected = ReferenceBackend(load(BILINEAR).weights).frame(window_now)
    np.testing.assert_array_equal(image, expected[0])
    np.testing.assert_array_equal(valid, expected[1])


def test_repeat_shows_the_frame_before_again():
    backend = MethodBackend("repeat")
    before, _ = backend.frame(slide(6, SF, (0.7, -0.4)))
    again, _ = backend.frame(slide(7, EF, (0.7, -0.4)))
    np.testing.assert_array_equal(again, before)


@pytest.mark.parametrize("method", ["extrapolate", "bilinear", "lanczos", "fxaa", "taau"])
def test_an_extrapolated_translation_is_exact(method):
    """By whole pixels, away from the edge: the EF is what the same method makes of the frame, had it been rendered."""
    motion = (2.0, -1.0)
    extrapolated, valid = MethodBackend(method).frame(slide(7, EF, motion))
    rendered, _ = MethodBackend(method).frame(slide(7, SF, motion))
    np.testing.assert_array_equal(inside(extrapolated), inside(rendered))
    assert valid[2:-2, 2:-2].all()
    assert not valid.all()


def test_extrapolate_leaves_the_occlusion_warp_out():
    """A hole shows what motion leads to; elsewhere it is bilinear."""
    window_now = slide(7, EF, (0.7, -0.4))
    stencils = window_now.stencils.copy()
    stencils[0, 8:12, 8:16] = 1  # an object that was not there
    window_now = replace(
        window_now, stencils=stencils, motions=window_now.motions * np.linspace(0.5, 1.5, W)[:, None].astype(np.float32)
    )
    image, valid = MethodBackend("extrapolate").frame(window_now)
    bilinear, _ = MethodBackend("bilinear").frame(window_now)
    hole = enlarge(~valid)
    assert hole.any()
    assert (image != bilinear)[hole].any()
    away = ~binary_dilation(hole, np.ones((3, 3)))
    np.testing.assert_array_equal(image[away], bilinear[away])


def test_lanczos_is_openimageio_s():
    """Its edges are another matter: it repeats the border."""
    x = noise()
    roi = oiio.ROI(0, 2 * W, 0, 2 * H, 0, 1, 0, 3)
    expected = oiio.ImageBufAlgo.resize(oiio.ImageBuf(x), filtername="lanczos3", roi=roi).get_pixels(oiio.FLOAT)
    # Values up to 1, absolute weights that add up to 1.5 a direction; OpenImageIO's sine is an approximation.
    assert np.abs(inside(lanczos_centres(x) - expected)).max() < 1e-5
    assert np.abs(inside(upsample_centres(x) - expected)).max() > 1e-2


def edge(slope, samples, size=48):
    """A white half-plane on black: its share of every pixel, by ``samples`` squared rays."""
    at = (np.arange(size * samples) + 0.5) / samples
    above = at[:, None] < size / 2 + slope * (at[None, :] - size / 2)
    share = above.reshape(size, samples, size, samples).mean(axis=(1, 3))
    return np.repeat(share[..., None], 3, axis=-1).astype(np.float32)


@pytest.mark.parametrize("slope", [-0.15, 1.0])
@pytest.mark.parametrize("upright", [False, True])
def test_fxaa_smoothes_a_jagged_edge(slope, upright):
    jagged, truth = edge(slope, 1), edge(slope, 16)
    if upright:
        jagged, truth = jagged.swapaxes(0, 1), truth.swapaxes(0, 1)
    smooth = fxaa(jagged)
    errors = [((x - truth) ** 2).mean() for x in (smooth, jagged)]
    assert errors[0] < (0.8 if slope == 1 else 0.4) * errors[1]  # each step of a diagonal is an end: little can be known
    assert smooth.min() >= 0
    assert smooth.max() <= 1


def test_taau_of_a_static_scene_is_its_upsampled_frame():
    """Nothing moves: nothing is blurred, however long it goes on, in EF as in SF."""
    backend, color = MethodBackend("taau"), noise()
    first, _ = backend.frame(inputs((0, 0, 0), [color] * 3))
    for steps in (EF, SF) * 2:
        image, _ = backend.frame(inputs(steps, [color] * 3))
        np.testing.assert_array_equal(image, first)
    within = enlarge(color)
    assert first.min() >= within.min()
    assert first.max() <= within.max()


def test_taau_takes_a_new_frame_by_its_count_within_its_neighbourhood():
    """One pixel flickers between its neighbours' values; in the second frame samples lie a quarter pixel aside."""
    y, x = np.indices((H, W))
    checker = np.where((x + y) % 2, 0.8, 0.2)[..., None].repeat(3, axis=-1).astype(np.float32)
    backend = MethodBackend("taau")
    before, _ = backend.frame(inputs((0, 0, 0), [checker] * 3))
    after, _ = backend.frame(inputs(SF, [1 - checker] * 3))
    alone, _ = MethodBackend("taau").frame(inputs((0, 0, 0), [1 - checker] * 3))
    share = (1 - np.hypot(0.25, 0.25)) / 2
    assert np.abs(inside(after - ((1 - share) * before + share * alone))).max() < 4 * 2**-23  # four roundings of values below 1


def test_taau_starts_anew_after_a_gap(write_frames):
    """After a gap in the frame numbers, or another size, the next frame does not depend on earlier ones."""
    small = open_sequence(write_frames(range(8), rendered=range(0, 8, 2), size=(8, 12), folder="small"), "stss")
    large = open_sequence(write_frames(range(8), rendered=range(0, 8, 2), size=(10, 12), folder="large"), "stss")
    later = [small.load(number) for number in range(4, 8)]

    def images(frames):
        return [output.image for output in Supersampler(backend=MethodBackend("taau"))(frames)]

    alone = images(later)
    for before in ([small.load(0), small.load(1)], [large.load(2), large.load(3)]):
        for image, expected in zip(images([*before, *later])[-4:], alone, strict=True):
            np.testing.assert_array_equal(image, expected)


@pytest.fixture
def sequence(write_frames):
    return open_sequence(write_frames(range(9), rendered=range(0, 9, 2), size=(16, 24)), "stss")


@pytest.mark.parametrize("method", METHODS)
def test_a_range_has_the_bits_of_the_whole(sequence, tmp_path, method):
    run(sequence, tmp_path / "whole", MethodBackend(method), "none", RunOptions())
    run(sequence, tmp_path / "part", MethodBackend(method), "none", RunOptions(frames=(5, 7)))
    part = frames_of(tmp_path / "part")
    assert sorted(name for name in part if name.endswith("exr")) == [f"frame.{n:04d}.exr" for n in (5, 6, 7)]
    assert part.items() <= frames_of(tmp_path / "whole").items()


def test_resume_keeps_what_is_right_or_is_refused(sequence, tmp_path):
    def run_method(method, **options):
        return run(sequence, tmp_path, MethodBackend(method), "none", RunOptions(**options))

    run_method("bilinear", frames=(0, 4))
    summary = run_method("bilinear", resume=True)
    assert (summary.count("kept"), summary.count("done")) == (5, 4)
    assert run_method("lanczos", resume=True).count("kept") == 0
    with pytest.raises(InputError, match="--resume: each output depends on all before it, so none can be kept"):
        run_method("taau", resume=True)


def test_methods_side_by_side(tmp_path):
    """A row and a folder for each; the scores are those of `stss compare`."""
    write_demo_sequence(tmp_path / "demo", 6, (24, 40))
    words = ["methods", tmp_path / "demo" / "frames", tmp_path / "demo" / "truth", "-o", tmp_path / "out", "--frames", "2:5"]
    table = call(*words)
    assert table.returncode == 0, table.stderr
    rows = {line.split()[0]: line.split() for line in table.stdout.splitlines() if line.strip().startswith(tuple(METHODS))}
    assert list(rows) == list(METHODS)  # no network, for its weights are bilinear
    assert "means of 2 SF and 2 EF" in table.stdout
    scores = json.loads(call(*words, "--methods", "repeat,lanczos", "--json", "--overwrite").stdout)
    folders = tmp_path / "out" / "lanczos", tmp_path / "demo" / "truth"
    alone = json.loads(call("compare", *folders, "--sequence", tmp_path / "demo" / "frames", "--json").stdout)
    assert scores["lanczos"]["means"] == alone["means"]
    assert rows["lanczos"][1] == f"{alone['means']['SF']['all']['psnr_rgb']:.2f}"
    assert rows["repeat"][-1] == f"{scores['repeat']['means']['EF']['all']['flicker']:.2f}"
    refused(call(*words, "--overwrite", "--methods", "dlss"), "methods: expected some of repeat, extrapolate, bilinear")
    assert choose_methods((), "some.safetensors") == (*METHODS, "network")
    with pytest.raises(InputError, match="each once"):
        choose_methods(("taau", "taau"), BILINEAR)


def test_frames_of_another_program_are_a_row_beside(tmp_path):
    """They say neither kind nor transfer nor holes: those are the frames', whoever made them."""
    write_demo_sequence(tmp_path / "demo", 6, (24, 40))
    words = ["methods", tmp_path / "demo" / "frames", tmp_path / "demo" / "truth", "-o", tmp_path / "out", "--frames", "2:5"]
    words += ["--methods", "lanczos", "--json"]
    assert call(*words).returncode == 0
    mine, page = tmp_path / "mine", tmp_path / "page.html"
    mine.mkdir()
    for n in range(2, 6):
        pixels = oiio.ImageBuf(str(tmp_path / "out" / "lanczos" / f"frame.{n:04d}.exr")).get_pixels()
        write_rgb(mine / f"own_{n}.exr", pixels)
    process = call(*words, "--overwrite", "--with", mine, "--html", page)
    assert process.returncode == 0, process.stderr
    scores = json.loads(process.stdout)
    assert scores["mine"]["means"] == scores["lanczos"]["means"]
    assert scores["mine"]["holes"] == scores["lanczos"]["holes"] > 0
    assert "Method mine" in page.read_text(encoding="utf-8")
    again = (*words, "--overwrite", "--with", mine)
    refused(call(*again, "--with", mine), f"{mine}: expected a folder with another name")
    refused(call(*again, "--with", tmp_path / "out" / "lanczos"), "lanczos is taken")
    (mine / "own_4.exr").unlink()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*")}
    refused(call(*again), f"{mine}: expected the frames of the other methods; frame 4 not there")
    refused(call(*words, "--overwrite", "--with", tmp_path / "none"), f"{tmp_path / 'none'}: no such folder")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*")} == before  # said before anything is computed


def test_every_frame_rendered_has_no_holes_to_score(write_frames, tmp_path):
    files = open_sequence(write_frames(range(3), size=(16, 24)), "stss")
    options = RunOptions(rendered="all")
    run(files, tmp_path / "truth", MethodBackend("lanczos"), "none", options)
    results = run_methods(
        files, tmp_path / "truth", tmp_path / "out", {"bilinear": lambda: (MethodBackend("bilinear"), "none")}, options
    )
    assert [mean.name for mean in results[0].comparison.means] == ["SF"]
    assert results[0].comparison.holes is None
    others = [shutil.copytree(tmp_path / "out" / "bilinear", tmp_path / "copy")]
    results = run_methods(
        files,
        tmp_path / "truth",
        tmp_path / "again",
        {"bilinear": lambda: (MethodBackend("bilinear"), "none")},
        options,
        others=others,
    )
    assert results[1].comparison.means == results[0].comparison.means


def test_temporal_upsampling_knows_the_jitter():
    """A plane at rest before a jittered camera: with the offsets its detail is found, with none or their opposites it is lost."""
    y, x = np.indices((2 * H, 2 * W)) / 2 - 0.25
    truth = texture(2 * x, 2 * y)

    def error(sign):
        offsets = [(0.5 * (n % 2), 0.5 * (n // 2 % 2)) for n in range(24)]
        method = Taau([(sign * i, sign * j) for i, j in offsets])
        before, image = offsets[0], truth
        for i, j in offsets:
            v, u = np.indices((H, W))
            one = inputs(SF, [texture(2 * (u - i), 2 * (v - j))] * 3, np.subtract(before, (i, j)))
            before, image = (i, j), method(one, prepare(one))
        return float(np.abs(inside(image - truth)).mean())

    right, unknown, opposite = map(error, (1, 0, -1))
    assert right < 0.5 * unknown
    assert right < 0.5 * opposite
