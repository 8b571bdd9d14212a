# SPDX-License-Identifier: MIT
"""`stss demo`: an analytic scene rendered at low resolution and half rate, supersampled, and compared with its truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from threading import Event

import numpy as np
from rich.console import Console

from conformance.scenes import DEMO, Rendered, render
from stss.frames.backends import DEFAULTS, Backend, open_backend
from stss.frames.compute_options import ComputeOptions
from stss.images.read_write import encode_channels, encode_rgb
from stss.pages.viewer import page_folder
from stss.quality.compare import Comparison, compare, print_comparison
from stss.quality.comparison_page import RenderedInputs, Version, write_comparison
from stss.quality.output_and_truth import find_pairs
from stss.run.job import folder_of, run
from stss.run.options import RunOptions
from stss.sequence.choose_weights import AUTO, choose_weights
from stss.sequence.reader import open_sequence
from stss.sequence.sequence import Sequence
from stss.weights.file import BILINEAR, REALTIME, LoadedWeights, load
from stss_ground.output.folder import OutputFolder
from stss_ground.output.places import require_places
from stss_ground.progress import show_progress
from stss_ref.arrays import Plane

FRAMES = 16
SIZE = (90, 160)
"""H, W of the frames; the truth has twice that."""
INPUT_SAMPLES = 9
"""Rays for each pixel of a rendered frame, as in an engine with antialiasing."""
SAMPLES = 16
"""Rays for each pixel of the truth."""
BACKGROUND = 1e10
"""Depth written where nothing was hit: the profile ``stss`` reads 1e9 and more as background."""

_CHANNELS: Mapping[str, tuple[str, ...]] = {
    "motion": ("motion.X", "motion.Y"),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "depth": ("depth.Z",),
    "position": ("position.X", "position.Y", "position.Z"),
    "stencil": ("stencil.X",),
    "nov": ("nov.X",),
    "base_color": ("basecolor.R", "basecolor.G", "basecolor.B"),
    "roughness": ("roughness.X",),
    "metallic": ("metallic.X",),
}
_HALF = ("R", "G", "B", *_CHANNELS["base_color"], *_CHANNELS["roughness"], *_CHANNELS["metallic"])
_MEANINGS = {
    "bilinear": "The newest rendered frame, in an EF warped to the current one, enlarged bilinearly: the method without its network.",
    "output": "Made by stss.",
}


def demo(
    out: Path,
    *,
    weights: str = AUTO,
    backend: str = "cl",
    compute: ComputeOptions = DEFAULTS,
    overwrite: bool = False,
    frames: int = FRAMES,
    size: tuple[int, int] = SIZE,
    console: Console,
) -> None:
    """Render the scene, run the main job on it, compare with the truth, and make a page to look at.

    The device is tested, and its kernels are built, by another process: the scene is rendered meanwhile.

    Writes ``out/frames``, ``out/truth``, ``out/output`` and ``out/page.html``; with weights other than ``bilinear`` also ``out/bilinear``,
    to compare with.

    Args:
        out: the folder; made if need be.
        weights: see `stss.sequence.choose_weights.choose_weights`.
        backend, compute: see ``stss.frames.backends.open_backend``.
        overwrite: replace an earlier demo.
        frames: how many display frames.
        size: H, W of the frames.
        console: where the table of scores is printed.

    Raises:
        InputError: ``out`` holds an earlier demo and ``overwrite`` is not set, or cannot be written to.
    """
    own_weights = None if weights == AUTO else load(weights)  # their errors must come before the rendering
    folders = [folder_of(out / "output"), folder_of(out / "bilinear"), page_folder(out / "page.html")]
    require_places(reads=[Path(weights)], folders=[_folder(out), *folders])

    def tell(line: str) -> None:
        console.print(line, soft_wrap=True, highlight=False, markup=False)

    def test_device() -> None:
        if backend == "cl":
            _test_device(own_weights, compute, tell)

    sequence = _render(out, frames, size, console, overwrite=overwrite, meanwhile=test_device)
    loaded = choose_weights(weights, sequence, tell)

    def score(name: str, method: LoadedWeights, engine: Backend) -> Comparison:
        with show_progress(console, frames, text=method.source) as advance:
            options = RunOptions(overwrite=overwrite)
            run(sequence, out / name, engine, method.label, options, lambda _: advance(), [Path(weights)])
        console.print(f"{method.source} against the truth:", highlight=False, markup=False)
        comparison = compare(out / name, out / "truth")
        print_comparison(comparison, console)
        return comparison

    comparisons: dict[str, Comparison] = {}
    if weights != BILINEAR:  # without a network the reference is fast enough, and needs no compilation
        bilinear = load(BILINEAR)
        comparisons["bilinear"] = score("bilinear", bilinear, open_backend("ref", bilinear.weights))
    comparisons["output"] = score("output", loaded, open_backend(backend, loaded, compute, tell=tell))
    _write_page(out, sequence, comparisons)
    console.print(f"page to look at: {out / 'page.html'}", soft_wrap=True, highlight=False, markup=False)


def _render(
    out: Path, frames: int, size: tuple[int, int], console: Console, *, overwrite: bool, meanwhile: Callable[[], None]
) -> Sequence:
    """Write the scene's frames and truths, and open the frames; ``meanwhile`` runs beside the writing, from the first frame on."""
    start, end = Event(), Event()

    def render() -> Sequence:
        with show_progress(console, frames, text="rendering") as advance:

            def go_on(number: int) -> None:
                del number
                if end.is_set():
                    raise CancelledError
                start.set()
                advance("rendering")

            write_demo_sequence(out, frames, size, overwrite=overwrite, on_frame=go_on)
        return open_sequence(out / "frames", "stss")

    with ThreadPoolExecutor(1) as pool:
        rendering = pool.submit(render)
        rendering.add_done_callback(lambda _: start.set())
        try:
            start.wait()  # an error of the first frame is told at once
            if not rendering.done():
                meanwhile()
            return rendering.result()
        finally:
            end.set()


def _write_page(out: Path, sequence: Sequence, comparisons: dict[str, Comparison]) -> None:
    """Write ``out/page.html``: every version's frames beside the truth."""
    versions = [
        Version(n, _MEANINGS[n], find_pairs(out / n, out / "truth")[0], comparison) for n, comparison in comparisons.items()
    ]
    folder = _folder(out)
    with folder.open(refusal=None):
        write_comparison(
            out / "page.html",
            "stss demo: half of the frames rendered, at half the size",
            versions,
            RenderedInputs(sequence, versions[-1].pairs),
            save=lambda path, text: folder.write(path.name, text.encode()),
        )
        folder.finish(remove_others=False)


def _test_device(weights: LoadedWeights | None, compute: ComputeOptions, tell: Callable[[str], None]) -> None:
    """Let another process test the device; weights that are not chosen yet are a set of ours, and both need the same layers."""
    from stss.devices.selection import choose  # opens the OpenCL library
    from stss.devices.trial import trial_for

    choose(compute.device, tell, trial=REALTIME if weights is None else trial_for(weights.weights))


def write_demo_sequence(
    out: Path,
    frames: int = FRAMES,
    size: tuple[int, int] = SIZE,
    *,
    overwrite: bool = False,
    on_frame: Callable[[int], None] = lambda number: None,
) -> None:
    """Write ``out/frames/demo.NNNN.exr``, profile ``stss``, and the truth ``out/truth/demo.NNNN.exr``, scene-linear.

    Frames are numbered from 0; the odd ones are not rendered: they have a G-buffer and motion, but no R, G, B.

    Args:
        out: the folder; made if need be.
        frames: how many display frames.
        size: H, W of the frames.
        overwrite: replace the frames of an earlier demo.
        on_frame: called with a frame's number after its files are written.

    Raises:
        InputError: ``out`` holds frames of an earlier demo and ``overwrite`` is not set, or cannot be written to.
    """
    folder = _folder(out)
    refusal = None if overwrite else "holds frames of an earlier demo; --overwrite replaces them"
    height, width = size
    with folder.open(refusal=refusal):
        for number in range(frames):
            low = render(DEMO, number, height, width, samples=INPUT_SAMPLES)
            channels = frame_channels(low, rendered=number % 2 == 0)
            path, metadata = demo_path(out / "frames", number), {"stss:scene": DEMO.name}
            folder.write(f"frames/{path.name}", encode_channels(path, channels, half=_HALF, metadata=metadata))
            truth = render(DEMO, number, 2 * height, 2 * width, samples=SAMPLES).color
            folder.write(f"truth/{path.name}", encode_rgb(path, truth, metadata=metadata))
            on_frame(number)
        folder.finish(remove_others=True)


def frame_channels(frame: Rendered, *, rendered: bool) -> dict[str, Plane]:
    """Channels of the profile ``stss``: name -> (H, W) float32; with R, G, B if the frame counts as ``rendered``."""
    planes: dict[str, Plane] = {name: frame.color[..., i] for i, name in enumerate("RGB")} if rendered else {}
    for buffer, names in _CHANNELS.items():
        values = np.atleast_3d(getattr(frame, buffer))
        planes.update({name: values[..., i] for i, name in enumerate(names)})
    planes["depth.Z"] = np.where(np.isinf(frame.depth), BACKGROUND, frame.depth)
    return {name: plane.astype(np.float32) for name, plane in planes.items()}


def demo_path(folder: Path, number: int) -> Path:
    """The path of a frame of the demo."""
    return folder / f"demo.{number:04d}.exr"


def _folder(out: Path) -> OutputFolder:
    return OutputFolder(out, ("", "frames", "truth"), r"demo\.\d+\.exr|page\.html")
