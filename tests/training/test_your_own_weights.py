"""The commands of docs/your-own-weights.md as they stand, in order, on five short paths in the project's own layout."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stss.images.read_write import write_channels
from stss.weights.file import load
from tests.app.conftest import frame_channels

pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "your-own-weights.md").read_text(encoding="utf-8")
STEPS = re.findall(r"^```sh\n(.*?)^```", PAGE[: PAGE.index("**What to expect.**")], re.M | re.S)
SHORTER = {
    " --profile unreal-mrq": "",
    "--steps 10000": "--steps 4 --crop 16 --batch 2",
    "--validate 200 --compile --half on": "--validate 2",
    "pip install -e '.[train]'\n": "",
}


def test_the_page_as_it_stands(tmp_path):
    for number in range(1, 6):
        low, high = (tmp_path / f"path{number:02}" / name for name in ("lr", "hr"))
        low.mkdir(parents=True)
        high.mkdir()
        for frame in range(7):
            write_channels(low / f"a.{frame:04}.exr", frame_channels(frame, (32, 48)))
        for frame in (5, 6):
            colors = frame_channels(2 * frame, (64, 96))
            write_channels(high / f"a.{frame:04}.exr", {name: colors[name] for name in "RGB"})
    script = "\n".join(STEPS)
    for words, fewer in SHORTER.items():
        assert words in script
        script = script.replace(words, fewer)
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": programs, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(
        ["bash", "-e", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=240
    )
    assert result.returncode == 0, result.stderr[-2000:]
    assert load(tmp_path / "runs/game/best.safetensors").weights.hole_fill == load("realtime").weights.hole_fill
    assert np.load(tmp_path / "data/game/path01/inputs.npy", mmap_mode="r").shape == (4, 32, 48, 35)
    assert {"out", "plain", "methods", "look.html"} <= {path.name for path in tmp_path.iterdir()}
