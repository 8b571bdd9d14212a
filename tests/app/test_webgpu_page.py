"""The page that supersamples in the browser: its picture is the reference's."""

import json
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from conformance.tolerance import BOUNDS
from stss.demo import write_demo_sequence
from stss.frames.backends import open_backend
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import prepare, window_at
from stss.frames.supersample import compute
from stss.images.color import transfer
from stss.sequence.reader import open_sequence
from stss.weights.file import load
from tests.app.browser import found

PAGE = Path(__file__).parents[2] / "examples" / "webgpu" / "page.py"
SOFTWARE = ("--headless=new", "--no-sandbox", "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader")
OUTER = b"""<!doctype html><iframe src="page.html"></iframe><script>
addEventListener("load", () => {
  const view = document.querySelector("iframe").contentWindow, state = view.document.getElementById("state");
  const look = async () => {
    if (state.textContent.startsWith("looking")) return setTimeout(look, 100);
    const image = state.textContent.includes(" ms") ? [...(await view.eval("show(1)"))[0]] : [];
    fetch("said", { method: "POST", body: JSON.stringify([state.textContent, image]) });
  };
  look();
});
</script>"""


def ask(page, folder):
    """What the page says, and the picture of its second frame; from a browser that this server gives both to."""
    said, ended = [], threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.end_headers()
            self.wfile.write(page if self.path == "/page.html" else OUTER)

        def do_POST(self):
            said.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            ended.set()

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/"
        command = [found(), *SOFTWARE, f"--user-data-dir={folder / 'profile'}", address]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as browser:
            try:
                assert ended.wait(120), "the browser says nothing"
            finally:
                browser.kill()
                server.shutdown()
    return said[0]


def test_the_page_makes_the_references_picture(tmp_path):
    if found() is None:
        pytest.skip("no Chromium")
    write_demo_sequence(tmp_path, 3, (16, 24))
    done = subprocess.run(
        [sys.executable, PAGE, tmp_path / "frames", tmp_path / "page.html", "--weights", "antialiased"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    # Its policy forbids that another page evaluates in it.
    page = (tmp_path / "page.html").read_bytes().replace(b"script-src ", b"script-src 'unsafe-eval' ")
    state, image = ask(page, tmp_path)
    if "no WebGPU" in state:
        pytest.skip(state)
    sequence = open_sequence(tmp_path / "frames")
    frames = [prepare(sequence.load(n), transfer("srgb"), "scale") for n in sequence.numbers]
    backend = open_backend("ref", load("antialiased").weights, ComputeOptions())
    want = compute(window_at(frames, 1), backend)
    assert np.abs(np.reshape(image, want.image.shape) - want.image).max() <= BOUNDS["network.float32"].floor, state
