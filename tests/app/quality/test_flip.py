# SPDX-License-Identifier: MIT
"""FLIP and VMAF in `stss compare`; skipped where the extra `metrics` is not installed."""

from __future__ import annotations

import io
import json
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from rich.console import Console

from stss.images.read_write import write_mask, write_rgb
from stss.quality.compare import compare, print_comparison
from stss.quality.flip_vmaf import Perceptual, flip_map, vmaf_scores
from stss.quality.metrics import score, to_8bit
from stss.run.options import RunOptions
from stss_ground.errors import InputError
from stss_lab.methods.methods_table import run_methods
from tests.hostile.cases import call

needs_flip = pytest.mark.skipif(find_spec("flip_evaluator") is None, reason="flip-evaluator is not installed: the extra metrics")
needs_vmaf = pytest.mark.skipif(find_spec("imageio_ffmpeg") is None, reason="imageio-ffmpeg is not installed: the extra metrics")

SIZE = (64, 96)


def scene(number):
    """A pattern that moves by two pixels a frame."""
    y, x = np.indices(SIZE)
    waves = [np.sin((x - 2 * number) / 3 + y / 9), np.cos(y / 4), np.sin((x - 2 * number) / 7 - y / 5)]
    return (0.5 + 0.4 * np.stack(waves, axis=-1)).astype(np.float32)


def blurred(image):
    return (image + np.roll(image, 1, 0) + np.roll(image, 1, 1) + np.roll(image, (1, 1), (0, 1))) / 4


@pytest.fixture
def folders(tmp_path):
    """Frames 1 to 4 and their truth: EF blurred, and wrong in its holes."""
    out, truth = tmp_path / "out", tmp_path / "truth"
    (out / "holes").mkdir(parents=True)
    truth.mkdir()
    for number in range(1, 5):
        kind = "EF" if number % 2 else "SF"
        image, name = scene(number), f"frame.{number:04d}.png"
        write_rgb(truth / name, image)
        if kind == "EF":
            hole = np.zeros((SIZE[0] // 2, SIZE[1] // 2), np.bool_)
            hole[4:12, 6:20] = True
            write_mask(out / "holes" / name, hole)
            image = blurred(image)
            image[10:22, 14:38] = 1
        write_rgb(out / name, image, metadata={"stss:kind": kind, "stss:transfer": "none"})
    return out, truth


@needs_flip
def test_flip_is_nought_where_nothing_differs():
    image, other = scene(1), scene(1)
    assert not flip_map(image, image).any()
    assert flip_map(np.zeros_like(image), np.ones_like(image)).min() > 0.9  # known from its paper: the largest error of all
    other[:8, :8] = 0
    difference = flip_map(other, image)
    assert difference.shape == SIZE
    assert difference.max() <= 1
    assert difference[:8, :8].min() > 0
    assert not difference[-8:, -8:].any()  # farther off than the eye's filters reach


@needs_vmaf
def test_vmaf_knows_better_from_worse():
    truths = [scene(n) for n in range(4)]
    equal = vmaf_scores((to_8bit(t), to_8bit(t)) for t in truths)
    worse = vmaf_scores((to_8bit(blurred(t)), to_8bit(t)) for t in truths)
    mixed = vmaf_scores((to_8bit(blurred(t) if n == 2 else t), to_8bit(t)) for n, t in enumerate(truths))
    assert len(equal) == len(worse) == 4
    assert min(equal) > 90
    assert max(worse) < min(equal)
    assert mixed[2] < min(mixed[0], mixed[1], mixed[3])  # each score is of its own frame


@needs_flip
@needs_vmaf
def test_compare_takes_them_when_asked(folders):
    result = call("compare", *folders, "--flip", "--vmaf", "--json")
    assert result.returncode == 0, result.stderr
    comparison = compare(*folders, perceptual=Perceptual(flip=True, vmaf=True))
    assert json.loads(result.stdout) == json.loads(comparison.to_json())
    sf, ef, mean = comparison.means
    assert sf.scores["all"].flip == 0
    assert 0 < ef.scores["all"].flip < ef.scores["holes"].flip
    assert ef.scores["all"].vmaf < sf.scores["all"].vmaf
    assert mean.scores["all"].vmaf == (sf.scores["all"].vmaf + ef.scores["all"].vmaf) / 2
    assert ef.scores["holes"].vmaf is None
    assert comparison.metrics == ["psnr_luma", "ssim", "psnr_rgb", "flip", "vmaf", "tpsnr"]
    frame = json.loads(comparison.to_json())["frames"][0]
    assert list(frame["all"]) == comparison.metrics
    assert list(frame["holes"]) == comparison.metrics[:-2]
    hole = np.zeros(SIZE, np.bool_)
    hole[10:22, 14:38] = True
    image = blurred(scene(1))
    image[hole] = 1
    assert score(image, scene(1), hole, flip=True)["holes"].flip == flip_map(image, scene(1))[hole].mean()
    console = Console(file=io.StringIO(), width=80)
    print_comparison(comparison, console)
    row = next(line.split() for line in console.file.getvalue().splitlines() if line.split()[:2] == ["1", "EF"])
    assert row[-4:-2] == [f"{comparison.rows[0].scores[region].flip:.4f}" for region in ("all", "edges")]
    assert row[-1] == f"{comparison.rows[0].scores['all'].vmaf:.2f}"  # whole, though the table is wider than the console


@pytest.mark.parametrize(("module", "option"), [("flip_evaluator", "flip"), ("imageio_ffmpeg", "vmaf")])
def test_a_missing_package_is_one_line(folders, monkeypatch, module, option):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(
        InputError, match=rf"^{module} is not installed: pip install {module}, or .* pip install '\.\[metrics\]'$"
    ):
        compare(*folders, perceptual=Perceptual(**{option: True}))
    with pytest.raises(InputError, match="is not installed"):  # before anything is run
        run_methods(None, folders[1], folders[0], {}, RunOptions(), perceptual=Perceptual(**{option: True}))
