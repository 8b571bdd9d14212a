"""The ablation: each row leaves something out."""

import pytest

from training.samples import write_film

pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")

from training import ablate
from training.data import Batches

ROWS = ("whole", "gbuffer", "erm", "SF")


def test_half_and_the_changes_of_crops_reach_every_step(data, monkeypatch, capsys):
    advance, halves, changes = ablate.advance, [], []

    def spy(state, batch, rate, aims):
        halves.append(aims.half)
        return advance(state, batch, rate, aims)

    def small(*args, **named):
        changes.append(named["how"])
        return Batches(*args, **named | {"side": 16})

    monkeypatch.setattr(ablate, "advance", spy)
    monkeypatch.setattr(ablate, "Batches", small)
    words = [str(data), "--rows", "whole", "--seeds", "0", "--steps", "2", "--most", "1", "--half", "--threads", "1"]
    ablate.main([*words, "--augment", "none"])
    assert halves == [True, True]
    assert "without whole, EF:" in capsys.readouterr().out
    ablate.main(words)
    assert changes == ["none", "all"]


@pytest.mark.thorough
def test_every_row_differs_from_the_whole(tmp_path, capsys):
    for seed, split in ((1, "training"), (2, "validation")):
        write_film(seed, "aliased", (48, 56), "occlusion_warp", split, tmp_path)
    ablate.main([str(tmp_path), "--seeds", "0", "--steps", "6", "--most", "1", "--augment", "none", "--rows", *ROWS])
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split(":")[0]: line.split(":")[1] for line in lines}
    assert len(rows) == 3 * len(ROWS) - 1
    for row in ROWS[1:3]:
        assert [rows[f"without {row}, {kind}"] for kind in ("SF", "EF")] != [
            rows[f"without whole, {kind}"] for kind in ("SF", "EF")
        ]
