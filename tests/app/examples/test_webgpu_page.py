"""The page that supersamples in the browser: its image is the reference's."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from conformance.tolerance import BOUNDS
from stss.demo import write_demo_sequence
from stss.frames.backends import open_backend
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import make_display_frame, window_at
from stss.frames.output import compute
from stss.images.color import transfer
from stss.sequence.reader import open_sequence
from stss.weights.file import load

PAGE = Path(__file__).parents[3] / "examples" / "webgpu" / "page.py"
SOFTWARE = ("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader")
SECOND = """
    const state = page.getElementById("state");
    while (state.textContent.startsWith("looking")) await new Promise((done) => setTimeout(done, 100));
    return [state.textContent, state.textContent.includes(" ms") ? [...(await view.eval("show(1)"))[0]] : []];
"""
"""The page's text, and the image of its second frame."""


def test_the_page_makes_the_references_picture(ask, tmp_path):
    write_demo_sequence(tmp_path, 3, (16, 24))
    process = subprocess.run(
        [sys.executable, PAGE, tmp_path / "frames", tmp_path / "page.html", "--weights", "antialiased"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    # Its policy forbids that another page evaluates in it.
    page = tmp_path / "page.html"
    page.write_bytes(page.read_bytes().replace(b"script-src ", b"script-src 'unsafe-eval' "))
    state, image = ask(page, SECOND, more=SOFTWARE)
    if "no WebGPU" in state:
        pytest.skip(state)
    sequence = open_sequence(tmp_path / "frames")
    frames = [make_display_frame(sequence.load(n), transfer("srgb"), "scale") for n in sequence.numbers]
    backend = open_backend("ref", load("antialiased").weights, ComputeOptions())
    want = compute(window_at(frames, 1), backend, transfer("none"))
    shown = np.clip(np.reshape(image, want.image.shape), 0, 1)  # as the page draws it
    assert np.abs(shown - want.image).max() <= BOUNDS["network.float32"].floor, state
