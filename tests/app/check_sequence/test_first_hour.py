"""A sequence without options: profile and camera are found from the files."""

import numpy as np
import pytest
from click.testing import CliRunner

from stss.cli.main import stss
from stss.images.headers import read_header
from stss.images.read_write import read_channels, read_rgb
from stss.sequence.find_profile import find_profile
from stss.sequence.reader import open_sequence
from stss.sequence.solve_camera import solve_camera
from stss_ground.errors import InputError

SIZE = 24, 32


def wall(rng, centre, turn):
    """Depth and position of bumpy surfaces seen by a camera at ``centre``, turned by ``turn`` radians."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    depth = rng.uniform(2, 30, SIZE)
    c, s = np.cos(turn), np.sin(turn)
    directions = np.stack([x / 20 - 0.8, 0.6 - y / 20, np.ones(SIZE)], axis=-1) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    return depth.astype(np.float32), (centre + depth[..., None] * directions).astype(np.float32)


@pytest.mark.parametrize("ray", [False, True])
def test_the_camera_follows_from_position_and_depth(ray):
    """Also where a tenth of the pixels are mixtures that fit nothing, and some see the sky."""
    rng = np.random.default_rng(3)
    centre = np.array([120.0, -45.0, 310.0])
    depth, position = wall(rng, centre, 0.7)
    if ray:
        depth = np.linalg.norm(position - centre, axis=-1).astype(np.float32)
    mixtures = rng.random(SIZE) < 0.1
    position[mixtures] += rng.normal(size=(mixtures.sum(), 3)).astype(np.float32)
    depth[0] = np.inf
    camera = solve_camera(depth, position, ray=ray)
    assert np.abs(camera.pose.position - centre).max() < 2**-23 * 310 * 30, camera  # positions are rounded to float32
    assert camera.residual < 1e-5


def test_a_camera_that_does_not_follow_is_not_made_up():
    """Positions in another space than the depths', too few pixels, a single plane through the camera's axis."""
    rng = np.random.default_rng(4)
    depth, position = wall(rng, np.zeros(3), 0.2)
    assert solve_camera(depth, rng.permutation(position)).residual > 1e-2
    assert solve_camera(np.full(SIZE, np.inf, np.float32), position) is None
    assert solve_camera(depth, np.zeros_like(position)) is None  # a pass that was not rendered
    assert solve_camera(depth, np.zeros_like(position), ray=True) is None


def test_check_and_run_need_neither_profile_nor_camera(write_frames, tmp_path):
    def bumpy(number, channels):
        depth = channels["depth.Z"] * (1 + 0.3 * channels["basecolor.R"])
        for axis in "XYZ":
            channels[f"position.{axis}"] = channels[f"position.{axis}"] * depth / 200
        channels["depth.Z"] = depth

    def without_nov(number, channels):
        bumpy(number, channels)
        del channels["nov.X"]

    lr = write_frames(range(4), change=without_nov, rendered=(0, 2))
    source = write_frames(range(4), change=bumpy, rendered=(0, 2), folder="given")
    assert find_profile(lr).name == "stss"
    runner = CliRunner()
    report = runner.invoke(stss, ["check", str(lr)], catch_exceptions=False)
    assert report.exit_code in (0, 1), report.output
    assert "profile: stss" in report.output
    assert "frames 0 to 3, 64 x 48 in, 128 x 96 out" in report.output.splitlines()[-1]
    for folder, out in ((lr, "a"), (source, "b")):
        result = runner.invoke(stss, ["run", str(folder), "-o", str(tmp_path / out), "--weights", "bilinear", "--backend", "ref"])
        assert result.exit_code == 0, result.output
    assert "profile: stss" in runner.invoke(stss, ["run", str(lr), "-o", str(tmp_path / "c"), "--backend", "ref"]).output
    images = [read_rgb(tmp_path / out / "frame.0003.exr") for out in "ab"]
    assert np.isfinite(images[0]).all()
    assert open_sequence(lr).solves_camera
    assert not open_sequence(source).solves_camera
    assert read_header(tmp_path / "a" / "frame.0003.exr").attributes["stss:profile"] == "stss"
    assert set(read_channels(tmp_path / "a" / "frame.0003.exr", ["R"])) == {"R"}


def test_names_that_fit_nothing_are_said(write_frames):
    lr = write_frames(range(2), change=lambda number, channels: {name: channels[name] for name in "RGB"})
    with pytest.raises(
        InputError, match=r"expected color, motion, .*, found a picture alone: R, G, B; turn on .* passes, or say"
    ):
        open_sequence(lr)
    lr = write_frames(range(2), change=lambda number, channels: {name: channels[name] for name in ("R", "G", "B", "depth.Z")})
    with pytest.raises(
        InputError, match=r"no profile alone: R, G, B, depth\.Z; say --profile stss, or --profile FILE\.toml for other"
    ):
        open_sequence(lr)


def test_check_proves_a_camera_right_or_wrong(write_frames, tmp_path):
    """The sequence of `bumpy` has its camera at the origin."""
    rng = np.random.default_rng(5)

    def change(number, channels):
        depth, position = wall(rng, np.zeros(3), 0.0)
        for index, axis in enumerate("XYZ"):
            channels[f"position.{axis}"] = position[..., index]
        return {name: plane[: SIZE[0], : SIZE[1]] for name, plane in channels.items() if name != "nov.X"} | {"depth.Z": depth}

    lr = write_frames(range(2), change=change)
    for place, expected in (("0,0,0", "agrees with position and depth"), ("0,5,0", "leave --camera out")):
        table = tmp_path / "camera.csv"
        table.write_text(f"frame,x,y,z\n0,{place}\n1,{place}\n")
        report = CliRunner().invoke(stss, ["check", str(lr), "--camera", str(table)], catch_exceptions=False)
        assert expected in report.output


def test_a_camera_in_another_unit_is_told_by_the_factor(write_frames, tmp_path):
    """Positions in cm, and a camera in metres."""
    rng = np.random.default_rng(6)
    centre = np.array([120.0, -45.0, 310.0])

    def change(number, channels):
        depth, position = wall(rng, centre, 0.3)
        for index, axis in enumerate("XYZ"):
            channels[f"position.{axis}"] = position[..., index]
        return {name: plane[: SIZE[0], : SIZE[1]] for name, plane in channels.items() if name != "nov.X"} | {"depth.Z": depth}

    lr = write_frames(range(2), change=change)
    table = tmp_path / "camera.csv"
    table.write_text("frame,x,y,z\n0,1.2,-0.45,3.1\n1,1.2,-0.45,3.1\n")
    report = CliRunner().invoke(stss, ["check", str(lr), "--camera", str(table)], catch_exceptions=False).output
    assert (
        "position and depth put it 100 times as far from (0, 0, 0) as --camera: positions and camera are in different" in report
    )
    assert "leave --camera out" not in report
    assert "nov: " not in report
