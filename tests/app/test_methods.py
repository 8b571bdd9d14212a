# SPDX-License-Identifier: MIT
"""Display frames without a network: what each method must keep, and how `stss methods` uses them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest

from stss.demo import write_demo_sequence
from stss.frames.backends import ReferenceBackend
from stss.frames.display_frame import frame_inputs
from stss.frames.supersample import plan
from stss.frames.supersampler import supersample
from stss.images.read_write import read_rgb
from stss.images.resample import catmull_rom, enlarged, lanczos_centres
from stss.run.job import run
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss.weights.file import BILINEAR, load
from stss_ground.errors import InputError
from stss_lab.baselines.fxaa import fxaa
from stss_lab.baselines.registry import ACCUMULATING, METHODS, MethodBackend
from stss_lab.methods.methods_table import choose_methods
from stss_ref.frame import FrameInputs
from stss_ref.resample import upsample_centres

SF, EF = (0, 2, 4), (1, 3, 5)
H, W = 20, 28
MARGIN = 12
"""Pixels of the output; farther from the frame's edge no kernel and no motion of these tests reads beyond it."""


def stss(*arguments):
    command = [sys.executable, "-m", "stss", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


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
@pytest.mark.parametrize("motion", [(0.0, 0.0), (0.3, -1.6), (40.0, 0.0), (np.nan, 0.0)])
def test_one_colour_stays_one_colour(method, motion):
    """Whatever moves, and after many frames."""
    color = np.broadcast_to(np.float32([0.2, 0.5, 0.9]), (H, W, 3))
    backend = MethodBackend(method)
    for steps in (SF, EF) * 4:
        image, valid = backend.frame(inputs(steps, [color] * 3, motion))
        assert image.shape == (2 * H, 2 * W, 3)
        assert image.dtype == np.float32
        assert valid.shape == (H, W)
        # Lanczos's weights add up to 1 but for rounding, twice: 12 products and sums each.
        assert np.abs(image - color[0, 0]).max() <= (24 * 2**-23 if method == "lanczos" else 0)


@pytest.mark.parametrize("steps", [SF, EF])
def test_bilinear_is_the_network_without_its_residual(steps):
    given = slide(7, steps, (0.7, -0.4))
    image, valid = MethodBackend("bilinear").frame(given)
    expected = ReferenceBackend(load(BILINEAR).weights).frame(given)
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
    given = slide(7, EF, (0.7, -0.4))
    stencils = given.stencils.copy()
    stencils[0, 8:12, 8:16] = 1  # an object that was not there
    given = replace(given, stencils=stencils, motions=given.motions * np.linspace(0.5, 1.5, W)[:, None].astype(np.float32))
    image, valid = MethodBackend("extrapolate").frame(given)
    bilinear, _ = MethodBackend("bilinear").frame(given)
    hole = enlarged(~valid)
    assert hole.any()
    assert (image != bilinear)[hole].any()
    trusted = ~np.pad(hole, 1, mode="edge")
    away = trusted[:-2, 1:-1] & trusted[2:, 1:-1] & trusted[1:-1, :-2] & trusted[1:-1, 2:] & trusted[:-2, :-2] & trusted[2:, 2:]
    away &= trusted[:-2, 2:] & trusted[2:, :-2] & ~hole
    np.testing.assert_array_equal(image[away], bilinear[away])


def test_lanczos_is_openimageio_s():
    """Its edges are another matter: it repeats the border."""
    x = noise()
    roi = oiio.ROI(0, 2 * W, 0, 2 * H, 0, 1, 0, 3)
    expected = oiio.ImageBufAlgo.resize(oiio.ImageBuf(x), filtername="lanczos3", roi=roi).get_pixels(oiio.FLOAT)
    # Values up to 1, absolute weights that add up to 1.5 a direction; OpenImageIO's sine is an approximation.
    assert np.abs(inside(lanczos_centres(x) - expected)).max() < 1e-5
    assert np.abs(inside(upsample_centres(x) - expected)).max() > 1e-2


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (3, 2)])
def test_the_smallest_frames(size):
    x = np.full((*size, 3), 0.5, np.float32)
    assert lanczos_centres(x).shape == (2 * size[0], 2 * size[1], 3)
    np.testing.assert_array_equal(fxaa(x), x)


def edge(slope, samples, size=48):
    """A white half-plane on black: its share of every pixel, by ``samples`` squared rays."""
    at = (np.arange(size * samples) + 0.5) / samples
    above = at[:, None] < size / 2 + slope * (at[None, :] - size / 2)
    share = above.reshape(size, samples, size, samples).mean(axis=(1, 3))
    return np.repeat(share[..., None], 3, axis=-1).astype(np.float32)


@pytest.mark.parametrize("slope", [0.1, -0.15, 0.3, 1.0])
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


def test_fxaa_leaves_alone_what_has_no_edge():
    """Flat, and a ramp too shallow for an edge; and around an edge, whatever is not next to it."""
    ramp = np.linspace(0.2, 0.9, W, dtype=np.float32)[None, :, None] * np.ones((H, 1, 3), np.float32)
    np.testing.assert_array_equal(fxaa(ramp), ramp)
    jagged = edge(0.1, 1)
    away = np.ptp([np.roll(jagged, (j, i), (0, 1)) for j in (-1, 0, 1) for i in (-1, 0, 1)], axis=0) == 0
    np.testing.assert_array_equal(fxaa(jagged)[away], jagged[away])


def test_catmull_rom_is_exact_at_pixels_and_for_parabolas():
    image = noise().astype(np.float64)
    y, x = np.indices((H, W)).astype(np.float64)
    np.testing.assert_array_equal(catmull_rom(image, x, y), image)
    np.testing.assert_array_equal(catmull_rom(image, x + 100, y), image[:, -1:].repeat(W, axis=1))
    parabola = (x**2 - x * y)[..., None]
    u, v = x[2:-2, 2:-2] + 0.3, y[2:-2, 2:-2] - 0.6
    # Values up to 27^2 in float64, 16 products.
    assert np.abs(catmull_rom(parabola, u, v)[..., 0] - (u**2 - u * v)).max() < 1e-10


def test_taau_of_a_static_scene_is_its_upsampled_frame():
    """Nothing moves: nothing is blurred, however long it goes on, in EF as in SF."""
    backend, color = MethodBackend("taau"), noise()
    first, _ = backend.frame(inputs((0, 0, 0), [color] * 3))
    for steps in (EF, SF) * 5:
        image, _ = backend.frame(inputs(steps, [color] * 3))
        np.testing.assert_array_equal(image, first)
    within = enlarged(color)
    assert first.min() >= within.min()
    assert first.max() <= within.max()


def test_taau_takes_a_new_frame_a_tenth_at_a_time_within_its_neighbourhood():
    """One pixel flickers between what its neighbours show: its history stays, but for a tenth."""
    y, x = np.indices((H, W))
    checker = np.where((x + y) % 2, 0.8, 0.2)[..., None].repeat(3, axis=-1).astype(np.float32)
    backend = MethodBackend("taau")
    before, _ = backend.frame(inputs((0, 0, 0), [checker] * 3))
    after, _ = backend.frame(inputs(SF, [1 - checker] * 3))
    alone, _ = MethodBackend("taau").frame(inputs((0, 0, 0), [1 - checker] * 3))
    assert np.abs(inside(after - (0.9 * before + 0.1 * alone))).max() < 4 * 2**-23  # four roundings of values below 1


def test_taau_forgets_what_the_neighbourhood_denies():
    backend = MethodBackend("taau")
    backend.frame(inputs((0, 0, 0), [np.ones((H, W, 3), np.float32)] * 3))
    black = np.zeros((H, W, 3), np.float32)
    np.testing.assert_array_equal(backend.frame(inputs(SF, [black] * 3))[0], enlarged(black))


@pytest.mark.parametrize("motion", [(60.0, 0.0), (np.nan, 1.0)])
def test_taau_has_no_history_off_screen(motion):
    backend = MethodBackend("taau")
    backend.frame(inputs((0, 0, 0), [noise(1)] * 3))
    found, _ = backend.frame(inputs(SF, [noise(2)] * 3, motion))
    np.testing.assert_array_equal(found, MethodBackend("taau").frame(inputs((0, 0, 0), [noise(2)] * 3))[0])


def test_taau_starts_anew_after_a_gap(write_frames):
    """Frame numbers that do not follow each other, or another size: what comes then knows nothing of what was."""
    small = open_sequence(write_frames(range(8), rendered=range(0, 8, 2), size=(16, 24), folder="small"), "stss")
    large = open_sequence(write_frames(range(8), rendered=range(0, 8, 2), size=(18, 24), folder="large"), "stss")
    later = [small.load(number) for number in range(4, 8)]

    def images(frames):
        return [output.image for output in supersample(frames, MethodBackend("taau"))]

    alone = images(later)
    for before in ([small.load(0), small.load(1)], [large.load(2), large.load(3)]):
        for found, expected in zip(images([*before, *later])[-4:], alone, strict=True):
            np.testing.assert_array_equal(found, expected)


def frames_of(out):
    return {str(path.relative_to(out)): path.read_bytes() for path in sorted(out.rglob("frame.*"))}


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


@pytest.mark.parametrize("method", METHODS)
def test_resume_keeps_what_is_right_or_is_refused(sequence, tmp_path, method):
    run(sequence, tmp_path, MethodBackend(method), "none", RunOptions(frames=(0, 4)))
    if method in ACCUMULATING:
        with pytest.raises(InputError, match="--resume: taau makes each output from all before it"):
            run(sequence, tmp_path, MethodBackend(method), "none", RunOptions(resume=True))
    else:
        summary = run(sequence, tmp_path, MethodBackend(method), "none", RunOptions(resume=True))
        assert (summary.count("kept"), summary.count("done")) == (5, 4)


def test_resume_does_not_mix_methods(sequence, tmp_path):
    run(sequence, tmp_path, MethodBackend("bilinear"), "none", RunOptions())
    summary = run(sequence, tmp_path, MethodBackend("lanczos"), "none", RunOptions(resume=True))
    assert summary.count("kept") == 0


def test_taau_goes_on_after_a_frame_that_cannot_be_read(sequence, write_frames, tmp_path):
    """A frame that is left out is a cut: the frames after it are as in a sequence that starts there."""
    files = sorted(sequence.path.iterdir())
    files[3].write_bytes(files[3].read_bytes()[:3000])
    run(sequence, tmp_path / "all", MethodBackend("taau"), "none", RunOptions(keep_going=True))
    alone = tmp_path / "alone"
    alone.mkdir()
    for path in files[4:]:
        (alone / path.name).write_bytes(path.read_bytes())
    run(open_sequence(alone, "stss"), tmp_path / "rest", MethodBackend("taau"), "none", RunOptions())
    for number in range(4, 9):
        found, expected = (read_rgb(tmp_path / name / f"frame.{number:04d}.exr") for name in ("all", "rest"))
        np.testing.assert_array_equal(found, expected)


def test_the_steps_tell_every_gap(sequence):
    """What TAAU's restart rests on: with a step back there is an output of the frame before."""
    from itertools import product

    from stss.frames.display_frame import prepare
    from stss.images.color import transfer

    made = [prepare(sequence.load(n, color=False), transfer("srgb"), "scale") for n in range(7)]
    for rendered in product([False, True], repeat=7):
        window = [replace(p, color=np.zeros((16, 24, 3), np.float32) if r else None) for p, r in zip(made, rendered, strict=True)]
        plans = [plan(window[max(0, n - 5) : n + 1]) for n in range(7)]
        for before, now, n in zip([None, *plans], plans, range(7), strict=False):
            if now is not None and max(now.steps) > 0:
                assert before is not None
                assert len(frame_inputs(window[max(0, n - 5) : n + 1], now.steps).motions) > 0


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    write_demo_sequence(out, 8, (24, 40))
    return out


def test_methods_side_by_side(demo, tmp_path):
    """A row and a folder for each; the scores are those of `stss compare`."""
    arguments = ["methods", demo / "frames", demo / "truth", "-o", tmp_path, "--frames", "2:7"]
    table = stss(*arguments)
    assert table.returncode == 0, table.stderr
    rows = {
        line.split()[0]: line.split() for line in table.stdout.splitlines() if line.split()[:1] and line.split()[0] in METHODS
    }
    assert list(rows) == list(METHODS)  # no network, for its weights are bilinear
    assert "means of 3 SF and 3 EF" in table.stdout
    found = json.loads(stss(*arguments, "--methods", "repeat,lanczos", "--json", "--overwrite").stdout)
    alone = json.loads(stss("compare", tmp_path / "lanczos", demo / "truth", "--json").stdout)
    assert found["lanczos"]["means"] == alone["means"]
    assert rows["lanczos"][1] == f"{alone['means']['SF']['all']['psnr_rgb']:.2f}"
    assert rows["repeat"][-1] == f"{found['repeat']['flicker']['means']['EF']['error']:.2f}"


def test_methods_of_choice(demo, tmp_path):
    result = stss("methods", demo / "frames", demo / "truth", "-o", tmp_path, "--methods", "network,repeat", "--backend", "ref")
    assert result.returncode == 0, result.stderr
    assert re.search(r"^network .*\n\s*repeat ", result.stdout, re.MULTILINE)
    result = stss("methods", demo / "frames", demo / "truth", "-o", tmp_path, "--methods", "dlss")
    assert result.returncode == 2
    assert "methods: expected some of repeat, extrapolate, bilinear" in result.stderr
    assert choose_methods((), "some.safetensors") == (*METHODS, "network")
    with pytest.raises(InputError, match="each once"):
        choose_methods(("taau", "taau"), BILINEAR)
