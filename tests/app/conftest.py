"""A small sequence on disk, in the project's own layout; a browser, if there is one."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest

from stss.images.read_write import write_channels
from tests.app import browser

PLAIN = ("--weights", "bilinear", "--backend", "ref")
"""A run that needs neither network nor device."""
VELOCITY = (1.5, 0.75)
"""Pixels a frame, right and down."""


def frame_channels(number, size=(48, 64), color=True):
    """A textured plane 2 m from a camera that looks along z and slides past it, from (0, 0, 0) at frame 0."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    u, v = x - VELOCITY[0] * number, y - VELOCITY[1] * number
    one = np.ones(size)
    channels = {
        "motion.X": -VELOCITY[0] * one,
        "motion.Y": -VELOCITY[1] * one,
        "normal.X": 0 * one,
        "normal.Y": 0 * one,
        "normal.Z": -one,
        "depth.Z": 200 * one,
        "position.X": u - size[1] / 2,
        "position.Y": v - size[0] / 2,
        "position.Z": 200 * one,
        "stencil.X": np.where(x < 8, 0.0, 1.0),
        "nov.X": one,
        "basecolor.R": 0.5 + 0.4 * np.sin(u / 3),
        "basecolor.G": 0.5 + 0.4 * np.sin(v / 4 + u / 7),
        "basecolor.B": 0.5 + 0.4 * np.cos(u / 5 - v / 3),
        "roughness.X": 0.5 * one,
        "metallic.X": 0 * one,
    }
    if color:
        channels |= {name: 2 * channels[f"basecolor.{name}"] for name in "RGB"}
    return channels


@pytest.fixture
def write_frames(tmp_path):
    """Write frames ``seq.NNNN.exr``; ``change(number, channels)`` may alter or replace the channels."""

    def write(numbers, *, change=None, rendered=None, folder="in", half=(), size=(48, 64), stem="seq"):
        (tmp_path / folder).mkdir(exist_ok=True)
        for number in numbers:
            channels = frame_channels(number, size, rendered is None or number in rendered)
            channels = (change(number, channels) if change else None) or channels
            # Not by write_channels if a test needs values that it refuses to write.
            write_raw(tmp_path / folder / f"{stem}.{number:04d}.exr", channels, half)
        return tmp_path / folder

    return write


def write_raw(path, channels, half=()):
    """Write an EXR, non-finite values too."""
    from stss.images import encode

    finite, encode.require_finite = encode.require_finite, lambda *_: None
    try:
        write_channels(path, channels, half=half)
    finally:
        encode.require_finite = finite


KINDS = {"uint8": "uint8", "uint16": "uint16", "uint32": "uint", "float32": "float"}
"""OpenImageIO's names for them."""


def write_parts(path, *parts, number_type=None):
    """Write an image by OpenImageIO alone; of each part (H, W, C) pixels, the channels' names and attributes, each with its arguments.

    ``number_type``: of its values in the file; None: their own.
    """
    output, specs = oiio.ImageOutput.create(str(path)), []
    for pixels, names, attributes in parts:
        spec = oiio.ImageSpec(*pixels.shape[1::-1], pixels.shape[2], number_type or KINDS[str(pixels.dtype)])
        spec.channelnames = names
        for name, value in attributes.items():
            spec.attribute(name, *value)
        specs.append(spec)
    assert output.open(str(path), tuple(specs))
    for index, (pixels, _, _) in enumerate(parts):
        assert index == 0 or output.open(str(path), specs[index], "AppendSubimage")
        assert output.write_image(np.ascontiguousarray(pixels))
    output.close()


def files(folder):
    """Every file below, by its path; a link counts as its text, and folders do not count."""
    paths = {path.relative_to(folder).as_posix(): path for path in Path(folder).rglob("*")}
    return {n: p.readlink() if p.is_symlink() else p.read_bytes() for n, p in paths.items() if p.is_symlink() or p.is_file()}


def frames_of(out):
    """The images and masks that a run wrote."""
    return {name: data for name, data in files(out).items() if "frame." in name}


@pytest.fixture(scope="session")
def blender_camera(tmp_path_factory):
    """The positions of the Blender reference's camera, frame by frame."""
    table = tmp_path_factory.mktemp("camera") / "camera.csv"
    lines = ["frame,x,y,z"]
    for frame in range(1, 15):
        s = frame / 60
        lines.append(f"{frame},{2.5 * np.sin(1.2 * s)},{-8 + 0.8 * s},{2.2 + 0.2 * np.sin(2 * s)}")
    table.write_text("\n".join(lines) + "\n")
    return table


@pytest.fixture(scope="session")
def ask():
    """`browser.ask`; tests that need it are skipped if no browser is installed."""
    if browser.find_browser() is None:
        pytest.skip(f"no browser: none of {', '.join(browser.NAMES)} is installed")
    return browser.ask
