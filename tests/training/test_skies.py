"""Clips of `training.skies`: what the table of cameras says, positions say too."""

import numpy as np
import pytest

from stss.images.headers import read_header
from stss.sequence.reader import open_sequence

mi = pytest.importorskip("mitsuba", reason="pip install mitsuba")
mi.set_variant("scalar_rgb")
skies = pytest.importorskip("training.skies")


@pytest.mark.parametrize("number", [0, 1], ids=["centre", "means"])
def test_a_clip_is_a_sequence_with_its_camera(tmp_path, monkeypatch, number):
    """Positions of pixels' centres and the table give one motion; means of few samples lie beside the centre."""
    monkeypatch.setattr(skies, "SIZE", (40, 64))
    monkeypatch.setattr(skies, "SAMPLES", 4)
    skies.render_clip(number, tmp_path / "sky")
    options = {"roughness": 0.5, "metallic": 0, "static": "camera"}
    solved = open_sequence(tmp_path / "sky" / "lr", "mitsuba", **options)
    table = open_sequence(tmp_path / "sky" / "lr", "mitsuba", **options, camera=tmp_path / "sky" / "camera.csv")
    for n in range(2, skies.FRAMES + 1):
        frame = table.load(n)
        if number == 0:
            assert np.abs(frame.motion - solved.load(n).motion).max() < 1e-2
        is_unit = np.abs(np.linalg.norm(frame.normal[np.isfinite(frame.depth)], axis=-1) - 1) < 1e-3
        assert is_unit.all() == (number == 0)
    truth = sorted((tmp_path / "sky" / "hr").iterdir())
    assert [path.name for path in truth] == ["sky.0006.exr", "sky.0007.exr"]
    assert read_header(truth[0]).display.size == (80, 128)
