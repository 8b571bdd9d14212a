"""The motion of the background: the findings of `stss check`, and the computation from the camera."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformance.scenes import SCENES, render
from conformance.scenes.render import look
from stss.check_sequence.background_verdict import measure_background
from stss.check_sequence.report import check
from stss.demo import demo_path, frame_channels
from stss.images.headers import read_header
from stss.images.read_write import read_channels, write_channels
from stss.quality.changes import Follower
from stss.sequence.background import projection_of, static_motion
from stss.sequence.camera import FAR, PLACE
from stss.sequence.reader import SequenceOptions, open_sequence
from stss_ground.errors import InputError
from tests.app.conftest import PLAIN
from tests.hostile.cases import call

SIZE = (48, 80)
FRAMES = 5
TURNS = 0.25
"""Pixels: the camera of the scene ``pan`` turns by more in each frame."""
RIGHT = 0.02
"""Pixels: how near the computed motion must be. Positions are float32: each is off by up to a thousandth of a pixel (measured: 0.002)."""


def write(folder, scene, change=lambda motion: motion):
    """A sequence of a scene whose background's motion is changed."""
    folder.mkdir()
    for number in range(FRAMES):
        view = render(SCENES[scene], number, *SIZE)
        channels = frame_channels(view, rendered=number % 2 == 0)
        missed = ~np.isfinite(view.depth)
        for name in ("motion.X", "motion.Y"):
            channels[name] = np.where(missed, change(channels[name]), channels[name]).astype(np.float32)
        write_channels(demo_path(folder, number), channels)
    return folder


def findings_of(folder, **options):
    return [
        (f.level, f.text) for f in check(folder, SequenceOptions("stss", **options)).findings if f.text.startswith("background")
    ]


@pytest.mark.parametrize(
    ("change", "words"),
    [(lambda m: 0 * m, "0"), (lambda m: 0 * m - 3, "off by"), (lambda m: 2 * m, "off by"), (lambda m: -m, "off by")],
    ids=["0", "flushed", "twice", "negated"],
)
def test_a_background_without_its_motion_is_told(tmp_path, change, words):
    ((level, text),) = findings_of(write(tmp_path / "in", "pan", change))
    assert level == "warning"
    assert text.startswith(f"background: its motion is {words}")
    assert "give --background camera" in text
    ((level, text),) = findings_of(tmp_path / "in", background="camera")
    assert (level, text[:31]) == ("note", "background: its motion is right")


@pytest.mark.parametrize("scene", ["pan", "demo", "static", "flythrough"])
def test_a_background_as_it_is_gives_no_warning(tmp_path, scene):
    assert [level for level, _ in findings_of(write(tmp_path / "in", scene))] == ["note"]


@pytest.mark.parametrize(("value", "words"), [(3e38, "off by"), (np.nan, "not finite"), (np.inf, "not finite")])
def test_a_background_that_is_not_finite_is_told(tmp_path, value, words):
    sequence = open_sequence(write(tmp_path / "in", "pan"), "stss")
    before, now = sequence.load(0), sequence.load(1)
    [verdict] = measure_background(projection_of(before), projection_of(now), now)
    assert verdict.lines()[0][0] == "note"
    now.motion[~np.isfinite(now.depth)] = value
    [verdict] = measure_background(projection_of(before), projection_of(now), now)
    assert verdict.lines()[0][1].startswith(f"background: its motion is {words}")


def test_a_background_that_was_behind_the_camera_counts_nowhere(tmp_path):
    """After a turn by 75 degrees part of it has no motion; the rest is judged."""
    sequence = open_sequence(write(tmp_path / "in", "pan"), "stss")
    before, now = sequence.load(0), sequence.load(1)
    turn = Rotation.from_euler("z", 75, degrees=True).as_matrix()
    [level] = measure_background(projection_of(before), projection_of(now), now)
    seen = projection_of(before)
    [turned] = measure_background(replace(seen, axes=seen.axes @ turn), projection_of(now), now)
    assert 0 < turned.share < level.share
    assert np.isfinite([turned.turns, turned.error]).all()


@pytest.mark.parametrize("scene", ["pan", "demo", "flythrough"])
def test_the_camera_gives_the_background_its_motion(tmp_path, scene):
    """Near the truth, and not a bit elsewhere. The first frame, which has none before it, stays as it is."""
    write(tmp_path / "right", scene), write(tmp_path / "in", scene, lambda m: 0 * m)
    right, zero = open_sequence(tmp_path / "right", "stss"), open_sequence(tmp_path / "in", "stss", background="camera")
    for number in (0, 3, 2, 1, 4):
        a, b = right.load(number), zero.load(number)
        missed = ~np.isfinite(a.depth)
        assert np.array_equal(a.motion[~missed], b.motion[~missed])
        if number:
            assert np.abs(a.motion - b.motion)[missed].max() < RIGHT
            assert (scene != "pan") or np.abs(b.motion[missed]).max() > TURNS
        else:
            assert not b.motion[missed].any()


@pytest.mark.parametrize("scene", ["pan", "demo", "flythrough"])
def test_a_table_gives_it_where_nothing_rests(tmp_path, scene):
    """By directions alone: every surface moves, so no position says where the camera is."""
    write(tmp_path / "right", scene), write(tmp_path / "in", scene, lambda m: 0 * m)
    right, lines = open_sequence(tmp_path / "right", "stss"), [",".join([*PLACE, *FAR])]
    for number in range(FRAMES):
        far = projection_of(right.load(number)).far * [[1], [SIZE[1] / SIZE[0]], [1]]  # a share of the height, not of the width
        lines.append(",".join(map(str, [number, 0, 0, 0, *far.ravel()])))
        path = demo_path(tmp_path / "in", number)
        write_channels(
            path, {**(planes := read_channels(path, read_header(path).channels)), "stencil.X": planes["stencil.X"] * 0 + 1}
        )
    (tmp_path / "camera.csv").write_text("\n".join(lines))
    sequence = open_sequence(tmp_path / "in", "stss", camera=tmp_path / "camera.csv", background="camera")
    for number in range(1, FRAMES):
        a, b = right.load(number), sequence.load(number)
        assert np.abs(a.motion - b.motion)[~np.isfinite(a.depth)].max() < RIGHT


def test_a_run_says_where_the_motion_is_from(tmp_path):
    folder = write(tmp_path / "in", "pan", lambda m: 0 * m)
    result = call("run", folder, "-o", tmp_path / "out", *PLAIN, "--background", "camera")
    assert result.returncode == 0, result.stderr
    assert "background: its motion is computed from the camera" in result.stderr
    call("run", folder, "-o", tmp_path / "plain", *PLAIN)
    for name in ("frame.0001.exr", "frame.0003.exr"):
        attributes = read_header(tmp_path / "out" / name).attributes
        assert attributes["stss:background"] == "motion from the camera"
        assert "stss:background" not in read_header(tmp_path / "plain" / name).attributes


def test_without_a_camera_the_background_has_no_motion(write_frames):
    """A plane alone leaves the camera open: that is an error, not a guess."""

    def change(number, channels):
        channels["depth.Z"][:20] = 0

    sequence = open_sequence(write_frames([1, 2], change=change), "stss", background="camera")
    sequence.load(1)
    with pytest.raises(
        InputError,
        match=r"seq\.0002\.exr: --background camera: positions of .* in frame 2 do not give the camera: .* in one plane; let static",
    ):
        sequence.load(2)


def write_without_motion(folder, scene):
    """A sequence of a scene whose files lack motion, or if things move, have it only there."""
    folder.mkdir()
    for number in range(FRAMES):
        view = render(SCENES[scene], number, *SIZE)
        channels = frame_channels(view, rendered=number % 2 == 0)
        for name in ("motion.X", "motion.Y"):
            motion = channels.pop(name)
            if view.stencil.any():
                channels[name] = np.where(view.stencil == 0, 0, motion).astype(np.float32)
        write_channels(demo_path(folder, number), channels)
    return folder


def write_table(path, right, units_per_cm):
    """The cameras of a sequence, in its unit of length, with their directions."""
    lines = [",".join([*PLACE, *FAR])]
    for number in range(FRAMES):
        projection = projection_of(right.load(number))
        far = projection.far * [[1], [SIZE[1] / SIZE[0]], [1]]  # a share of the height, not of the width
        lines.append(",".join(map(str, [number, *projection.camera * units_per_cm, *far.ravel()])))
    path.write_text("\n".join(lines))
    return path


def test_a_camera_at_rest_moves_nothing(tmp_path):
    """Wherever in its pixel a position was sampled."""
    frame = open_sequence(write(tmp_path / "in", "pan"), "stss").load(0)
    projection = projection_of(frame)
    position = frame.position + np.random.default_rng(0).normal(0, 5, frame.position.shape).astype(np.float32)
    assert not static_motion(projection, projection, position.reshape(-1, 3)).any()


def test_what_was_behind_the_camera_has_no_place_before(tmp_path):
    frame = open_sequence(write(tmp_path / "in", "pan"), "stss").load(0)
    projection = projection_of(frame)
    behind = 2 * projection.camera - frame.position[40:, :8]
    assert np.isnan(static_motion(projection, projection, behind.reshape(-1, 3))).all()


@pytest.mark.parametrize("table", [False, True], ids=["positions", "table"])
@pytest.mark.parametrize("scene", ["pan", "flythrough"])
def test_the_camera_gives_static_geometry_its_motion(tmp_path, monkeypatch, scene, table):
    """Near the truth, in any order of frames, by blocks of seven rows."""
    monkeypatch.setattr("stss.sequence.sequence.BLOCK", 7 * SIZE[1])
    right = open_sequence(write(tmp_path / "right", scene), "stss")
    camera = write_table(tmp_path / "camera.csv", right, 1) if table else None
    still = open_sequence(write_without_motion(tmp_path / "in", scene), "stss", camera=camera, static="camera")
    for number in (3, 0, 1, 2, 4):
        a, b, rest = right.load(number).motion, still.load(number).motion, right.load(number).stencil == 0
        if number:
            assert np.abs(a[rest]).max() > TURNS
            assert np.abs(a - b).max() < RIGHT
        else:
            assert not b[rest].any()


def test_positions_may_be_sampled_anywhere_in_their_pixels(tmp_path):
    """As by a path tracer's only sample. The camera is as certain, and motion is that of the sample."""
    folder, random, right = write_without_motion(tmp_path / "in", "pan"), np.random.default_rng(1), {}
    for number in range(FRAMES):
        y, x = np.mgrid[: SIZE[0], : SIZE[1]] + random.uniform(-0.5, 0.5, (2, *SIZE))
        seen = look(SCENES["pan"], number, x.ravel(), y.ravel(), SIZE)
        planes = read_channels(path := demo_path(folder, number), read_header(demo_path(folder, number)).channels)
        hit = np.isfinite(seen.depth).reshape(SIZE)
        planes["depth.Z"] = np.where(hit, seen.depth.reshape(SIZE), 1e9)
        for i, c in enumerate("XYZ"):
            planes[f"position.{c}"] = np.where(hit, seen.position[:, i].reshape(SIZE), 0)
            planes[f"normal.{c}"] = np.where(hit, seen.normal[:, i].reshape(SIZE), 0)
        write_channels(path, {name: plane.astype(np.float32) for name, plane in planes.items()})
        right[number] = seen.motion.reshape(*SIZE, 2), hit
    still = open_sequence(folder, "stss", static="camera")
    for number in range(1, FRAMES):
        motion, hit = right[number]
        assert np.median(np.abs(still.load(number).motion - motion)[hit]) < RIGHT


def hide(path):
    """Nothing is hit any more: no position tells where the camera is."""
    planes = read_channels(path, read_header(path).channels)
    hidden = {name: 0 * plane for name, plane in planes.items()} | {"depth.Z": np.full_like(planes["depth.Z"], 1e9)}
    write_channels(path, hidden)


@pytest.mark.parametrize("motion", ["--static", "--background"])
def test_a_camera_that_no_output_needs_may_be_unknown(tmp_path, motion):
    """A black frame before a cut, which ends a shot: the shot behind it has the bits that it has alone."""
    folder = write(tmp_path / "in", "pan")
    hide(demo_path(folder, 1))
    run = ("run", folder, *PLAIN, motion, "camera", "-o")
    result = call(*run, tmp_path / "out")
    assert result.returncode == 2
    assert f"demo.0001.exr: {motion} camera: positions of static geometry in frame 1 do not give the camera" in result.stderr
    assert "if a shot begins with frame 1, name it in --cuts" in result.stderr
    result = call(*run, tmp_path / "cut", "--cuts", "2", "--frames", "2:4")
    assert result.returncode == 0, result.stderr
    report = check(folder, SequenceOptions("stss", **{motion[2:]: "camera"}))
    (found,) = (f.text for f in report.findings if "name it in --cuts" in f.text)
    assert found.startswith(str(demo_path(folder, 1)))
    assert report.status == 1
    for number in (0, 1):
        demo_path(folder, number).unlink()
    result = call(*run, tmp_path / "alone")
    assert result.returncode == 0, result.stderr
    for number in (2, 3, 4):
        name = f"frame.{number:04d}.exr"
        assert np.array_equal(*(read_channels(tmp_path / of / name, tuple("RGB"))["G"] for of in ("cut", "alone")))


def test_a_first_frame_is_read_without_the_one_before(tmp_path):
    folder = write_without_motion(tmp_path / "in", "pan")
    hide(demo_path(folder, 1))
    sequence = open_sequence(folder, "stss", static="camera")
    frame = sequence.load(2, cut=True)
    assert frame.cut
    assert not frame.motion.any()
    with pytest.raises(InputError, match="in frame 1 do not give the camera"):
        sequence.load(2)
    assert not sequence.load(4).cut
    images = 2 * (np.zeros((2 * SIZE[0], 2 * SIZE[1], 3), np.float32),)
    follower = Follower(sequence)
    assert [follower.flicker(number, images, images) for number in (2, 3)] == [None, 0]


def test_what_moves_by_itself_keeps_the_motion_of_its_files(tmp_path):
    folder = write(tmp_path / "in", "demo", lambda m: 0 * m)
    files, camera = open_sequence(folder, "stss"), open_sequence(folder, "stss", static="camera")
    moves = files.load(2).stencil != 0
    assert moves.any()
    assert np.array_equal(files.load(2).motion[moves], camera.load(2).motion[moves])


def test_what_moves_by_itself_needs_a_motion(tmp_path):
    folder = write_without_motion(tmp_path / "in", "pan")
    for number in range(FRAMES):
        planes = read_channels(path := demo_path(folder, number), read_header(demo_path(folder, number)).channels)
        planes["stencil.X"][20, 30:] = 3
        write_channels(path, planes)
    result = call("run", folder, "-o", tmp_path / "out", *PLAIN, "--static", "camera")
    assert result.returncode == 2
    assert "demo.0001.exr: --static camera: no motion for objects whose stencil is not 0, the first 3; write" in result.stderr
    result = call("run", tmp_path / "in", "-o", tmp_path / "out", *PLAIN)
    assert result.returncode == 2
    assert "no motion" in result.stderr


def test_mitsuba_needs_no_motion_where_the_camera_alone_moves(tmp_path):
    """Its channels' names; positions in metres, distances along the ray."""
    folder = write_without_motion(tmp_path / "in", "pan")
    right = open_sequence(write(tmp_path / "right", "pan"), "stss")
    for number in range(FRAMES):
        path, b = demo_path(folder, number), right.load(number)
        position = np.where(np.isfinite(b.depth)[..., None], b.position / 100, 0)
        camera = projection_of(b).camera / 100
        ray = np.where(np.isfinite(b.depth), np.linalg.norm(position - camera, axis=-1), 0)
        color = np.zeros((*SIZE, 3), np.float32) if b.color is None else b.color
        groups = {"R G B": color, "albedo.R albedo.G albedo.B": b.base_color, "normal.X normal.Y normal.Z": b.normal}
        groups |= {"position.X position.Y position.Z": position, "depth.T": ray[..., None]}
        planes = {name: of[..., i].astype(np.float32) for names, of in groups.items() for i, name in enumerate(names.split())}
        write_channels(path, planes)
    options = ("--profile", "mitsuba", "--roughness", "0.5", "--metallic", "0")
    result = call("check", folder, *options)
    assert result.returncode == 2
    assert "Mitsuba has no motion AOV: give --static camera where only the camera moves" in result.stdout + result.stderr
    result = call("check", folder, *options, "--static", "camera")
    assert result.returncode == 0, result.stdout + result.stderr
    result = call(
        "run", folder, "-o", tmp_path / "out", "--backend", "ref", "--weights", "bilinear", *options, "--static", "camera"
    )
    assert result.returncode == 0, result.stderr
    assert "motion: of the background and of static geometry it is computed from the camera" in result.stderr
    assert read_header(tmp_path / "out" / "frame.0003.exr").attributes["stss:static"] == "motion from the camera"
    for camera in (None, write_table(tmp_path / "camera.csv", right, 0.01)):
        still = open_sequence(folder, "mitsuba", metallic=0, roughness=0.5, static="camera", camera=camera)
        for number in range(1, FRAMES):
            assert np.abs(still.load(number).motion - right.load(number).motion).max() < RIGHT


def write_means(folder, *, of_depth=True, samples=4):
    """The scene ``flythrough`` as a path tracer writes it: means over the samples of a pixel, of which those that miss count as 0."""
    folder.mkdir()
    for number in range(FRAMES):
        channels = frame_channels(render(SCENES["flythrough"], number, *SIZE), rendered=number % 2 == 0)
        y, x = (np.mgrid[: samples * SIZE[0], : samples * SIZE[1]] + 0.5) / samples - 0.5
        seen = look(SCENES["flythrough"], number, x.ravel(), y.ravel(), SIZE)
        hit = np.isfinite(seen.depth)[:, None]
        planes = np.where(hit, np.column_stack([seen.position, seen.depth]), 0)
        mean = planes.reshape(SIZE[0], samples, SIZE[1], samples, 4).mean(axis=(1, 3)).astype(np.float32)
        for i, name in enumerate(["position.X", "position.Y", "position.Z", "depth.Z"][: 4 if of_depth else 3]):
            channels[name] = mean[..., i]
        write_channels(demo_path(folder, number), channels)
    return folder


def test_means_of_surfaces_and_of_nothing_are_told(tmp_path):
    """As of Mitsuba's AOVs of many samples. Blender's depth is no mean, and nothing can be done about its positions: no warning."""
    texts = [f.text for f in check(write_means(tmp_path / "means"), SequenceOptions("stss")).findings if f.level == "warning"]
    (text,) = (text for text in texts if text.startswith("position, depth: "))
    assert "of the pixels along the background have the mean of a surface and of 0: render them with one sample" in text
    for folder in (write_means(tmp_path / "blender", of_depth=False), write_means(tmp_path / "centre", samples=1)):
        assert "along the background" not in " ".join(f.text for f in check(folder, SequenceOptions("stss")).findings)
