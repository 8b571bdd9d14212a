"""Sequences of files as frames in the conventions of the specification."""

import math
import shutil

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest

from stss.images.headers import read_header
from stss.images.read_write import read_channels, write_channels
from stss.sequence.conventions import BACKGROUND_POSITION
from stss.sequence.profiles import BUFFERS, load_profile
from stss.sequence.reader import open_sequence
from stss_ground.errors import InputError
from tests.app.conftest import frame_channels, write_parts


def test_frames_are_found_and_read_as_written(write_frames):
    folder = write_frames([1, 2, 3, 4], rendered={2, 4})
    sequence = open_sequence(folder, "stss")
    assert sequence.numbers == (1, 2, 3, 4)
    assert sequence.rendered == {2, 4}
    assert sequence.size == (48, 64)
    assert sequence.files(3) == (folder / "seq.0003.exr",)
    channels = read_channels(folder / "seq.0004.exr", ["R", "motion.Y", "position.X", "basecolor.G", "nov.X"])
    frame = sequence.load(4)
    assert frame.color is not None
    assert {(a.dtype, a.flags.c_contiguous) for a in vars(frame).values() if isinstance(a, np.ndarray)} == {
        (np.dtype("float32"), True)
    }
    np.testing.assert_array_equal(frame.color[..., 0], channels["R"])
    np.testing.assert_array_equal(frame.motion[..., 1], channels["motion.Y"])
    np.testing.assert_array_equal(frame.position[..., 0], channels["position.X"])
    np.testing.assert_array_equal(frame.base_color[..., 1], channels["basecolor.G"])
    np.testing.assert_array_equal(frame.nov, channels["nov.X"])
    assert sequence.load(3).color is None
    assert sequence.load(4, color=False).color is None
    missing = "frame 5: not there; STSS needs the G-buffer and motion of every display frame, rendered or not"
    for ask in (sequence.load, sequence.files):
        with pytest.raises(InputError, match=missing):
            ask(5)
    with pytest.raises(InputError, match=r"expected a folder, or a pattern like .*; found nothing"):
        open_sequence(folder / "no", "stss")


@pytest.mark.parametrize(("colour", "others"), ["ab", "ba"])
def test_of_several_files_that_of_the_colour_says_what_colours_mean(tmp_path, colour, others):
    """Whatever the order of the files' names: other passes are tagged as their program likes."""
    names = [name for name in frame_channels(0) if name not in "RGB"]
    for ending, own, rate in ((others, names, 24.0), (colour, [*"RGB"], 25.0)):
        pixels = np.stack([np.float32(frame_channels(0)[name]) for name in own], axis=-1)
        write_parts(tmp_path / f"x_{ending}.0000.exr", (pixels, own, {"whiteLuminance": ("float", rate)}))
    files = dict.fromkeys((buffer for buffer in BUFFERS if buffer != "color"), f"_{others}") | {"color": f"_{colour}"}
    frame = open_sequence(tmp_path, load_profile("stss", files=files)).frames[0]
    assert frame.attributes["whiteLuminance"] == 25


def test_frames_that_are_kept_are_those_that_were_asked_for(write_frames):
    """With colour, without it, with more planes; and nothing beyond the room for them."""
    sequence = open_sequence(write_frames([0, 1]), "stss")
    sequence.keeps = 1 << 20
    first = sequence.load(0)
    assert sequence.load(0) is first
    assert sequence.load(0, color=False).color is None
    assert sequence.load(0, also=["nov"]).carried.keys() == {"nov.X"}
    assert sequence.load(0) is first
    sequence.keeps = 0
    assert sequence.load(1) is not sequence.load(1)


def test_a_buffer_that_one_frame_lacks(write_frames):
    folder = write_frames([1, 2, 3], change=lambda n, c: c if n != 2 else {k: v for k, v in c.items() if k != "motion.X"})
    sequence = open_sequence(folder, "stss")
    sequence.load(1)
    with pytest.raises(InputError, match=r"seq\.0002\.exr: no motion: profile stss expects motion\.X, \.Y; found B, G"):
        sequence.load(2)


def test_the_odd_size_is_named(write_frames):
    write_frames([1, 2, 4])
    folder = write_frames([3], size=(48, 66))
    with pytest.raises(InputError, match=r"seq\.0003\.exr: 66 x 48; expected 64 x 48, as seq\.0001\.exr is"):
        open_sequence(folder, "stss")


def test_which_files_belong_to_the_sequence(write_frames):
    """The number is the last group of digits; hidden files, other kinds and names without a number are not frames."""
    folder = write_frames([7, 12], stem="shot2_v03")
    (folder / ".shot2_v03.0008.exr").write_bytes(b"partial")
    (folder / "notes.0009.txt").write_text("")
    shutil.copy(folder / "shot2_v03.0007.exr", folder / "still.exr")
    assert open_sequence(folder, "stss").numbers == (7, 12)
    write_frames([1], stem="other")
    with pytest.raises(
        InputError, match=r"in: several sequences: shot2_v03\.####\.exr \(2 frames\), other\.####\.exr \(1 frame\); give"
    ):
        open_sequence(folder, "stss")
    assert open_sequence(folder / "other.####.exr", "stss").numbers == (1,)
    assert open_sequence(folder / "shot2_v03.#.exr", "stss").numbers == (7, 12)
    shutil.copy(folder / "other.0001.exr", folder / "other.01.exr")
    with pytest.raises(InputError, match=r"other\.01\.exr: the same frame as other\.0001\.exr"):
        open_sequence(folder / "other.####.exr", "stss")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e9, 0, -1])
def test_where_nothing_was_hit(write_frames, value):
    def change(number, channels):
        channels["depth.Z"][5, 20] = value
        channels["metallic.X"][5, 20:22] = 1

    frame = open_sequence(write_frames([1], change=change), "stss").load(1)
    assert np.isinf(frame.depth[5, 20])
    assert np.isfinite(frame.depth).sum() == frame.depth.size - 1
    assert (frame.position[5, 20] == BACKGROUND_POSITION).all()
    for name in ("normal", "nov", "stencil", "base_color", "roughness", "metallic"):
        assert not getattr(frame, name)[5, 20].any(), name
        assert getattr(frame, name)[5, 21].any(), name


def test_non_finite_values_that_mean_something(write_frames):
    """Motion: off screen, kept. Position: a hole. Huge motion is kept too."""

    def change(number, channels):
        channels["motion.X"][0, :3] = np.nan, np.inf, 3e7
        channels["position.Y"][0, :2] = np.nan, -np.inf

    frame = open_sequence(write_frames([1], change=change), "stss").load(1)
    np.testing.assert_array_equal(frame.motion[0, :3, 0], np.float32([np.nan, np.inf, 3e7]))
    assert np.isnan(frame.position[0, :2]).all()
    assert np.isfinite(frame.position[0, 2:]).all()


def test_ranges(write_frames):
    """Base colour, roughness and metallic are clipped; colour and fractional object numbers are passed on."""

    def change(number, channels):
        for name in ("basecolor.R", "roughness.X", "metallic.X"):
            channels[name][0, :2] = -0.5, 1.5
        channels["R"][0, :2] = -3, 70000
        channels["stencil.X"] = channels["stencil.X"] + 0.25

    frame = open_sequence(write_frames([1], change=change), "stss").load(1)
    for plane in (frame.base_color[..., 0], frame.roughness, frame.metallic):
        np.testing.assert_array_equal(plane[0, :2], [0, 1])
    assert frame.color is not None
    np.testing.assert_array_equal(frame.color[0, :2, 0], [-3, 70000])
    np.testing.assert_array_equal(np.unique(frame.stencil), [0.25, 1.25])


def without(*names):
    return lambda _, channels: {k: v for k, v in channels.items() if k not in names}


def test_constants_stand_in_where_there_is_no_channel(write_frames):
    folder = write_frames([1], change=without("roughness.X", "metallic.X"))
    with pytest.raises(InputError, match="no roughness"):
        open_sequence(folder, "stss", metallic=0)
    sequence = open_sequence(folder, "stss", metallic=0, roughness=0.25)
    frame = sequence.load(1)
    np.testing.assert_array_equal(frame.roughness, np.full((48, 64), 0.25))
    np.testing.assert_array_equal(frame.metallic, np.zeros((48, 64)))
    with pytest.raises(InputError, match=r"roughness: expected a number from 0 to 1, found 1\.5"):
        open_sequence(folder, "stss", metallic=0, roughness=1.5)
    folder = write_frames([1])
    np.testing.assert_array_equal(open_sequence(folder, "stss", roughness=0.1).load(1).roughness, np.full((48, 64), 0.5))


def test_nov_from_the_camera(write_frames, tmp_path):
    """A plane at z = 200 seen from the origin, its normal towards us but not of unit length."""

    def change(number, channels):
        channels["normal.Z"] = channels["normal.Z"] * 3
        channels["position.X"][0, 0] = np.nan
        return without("nov.X")(number, channels)

    folder = write_frames([1, 2], change=change)
    with pytest.raises(InputError, match=r"do not give one \(too few surfaces\): give --camera CSV .* or a channel nov\.X"):
        open_sequence(folder, "stss").load(1)
    table = tmp_path / "camera.csv"
    table.write_text("frame,x,y,z\n1,0,0,0\n2,0,0,400\n")
    sequence = open_sequence(folder, "stss", camera=table)
    frame = sequence.load(1)
    x, y = frame.position[..., 0], frame.position[..., 1]
    expected = 200 / np.sqrt(x.astype(np.float64) ** 2 + y.astype(np.float64) ** 2 + 200**2)
    expected[0, 0] = 0
    assert np.abs(frame.nov - expected).max() <= 2.0**-24
    assert (sequence.load(2).nov[1:] < 0).all()


def test_a_camera_that_is_not_found_and_the_background_that_may_be_the_cause(write_frames):
    """A sky of depth 1e6 in a profile without it; a plane that faces the camera has no such pixels; a sky alone needs no camera."""

    def change(number, channels):
        channels["depth.Z"][: 16 * (number == 1) + 48 * (number == 3)] = 1e6 if number == 1 else 0
        return without("nov.X")(number, channels)

    sequence = open_sequence(write_frames([1, 2, 3], change=change), "stss")
    hint = r"1024 pixels have depth 1e\+06: if nothing was hit there, give a profile with this background\): give --camera CSV"
    with pytest.raises(InputError, match=hint):
        sequence.load(1)
    with pytest.raises(InputError, match=r"do not give one \(too few surfaces\): give --camera CSV"):
        sequence.load(2)
    assert not sequence.load(3).nov.any()


WIDE = "frame,x,y,z,ux,uy,uz,vx,vy,vz,wx,wy,wz"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected the first line to be frame,x,y,z, which ux,.* may follow; found nothing"),
        ("frame,x,y,z\n\n1,0,0,nan\n", "line 3: expected a frame number and 3 numbers"),
        (f"{WIDE}\n1,0,0,0\n", "line 2: expected a frame number and 12 numbers"),
        (f"{WIDE}\n1,0,0,0,1,0,0,0,1,0,1,1,0\n", "line 2: ux,.*,wz show no picture"),
        ("frame,x,y,z\n1,0,0,0\n1,0,0,0\n", "line 3: frame 1 appears twice"),
        ("frame,x,y,z\n2,0,0,0\n", "no line for frame 1"),
        ("frame,x,y,z\n", "no line for frame 1"),
    ],
)
def test_camera_tables(write_frames, tmp_path, text, message):
    folder = write_frames([1])
    table = tmp_path / "camera.csv"
    table.write_text(text)
    for keep_going in (False, True):  # the second leaves out single frames, and not all
        with pytest.raises(InputError, match=rf"camera\.csv: {message}"):
            open_sequence(folder, "stss", camera=table, keep_going=keep_going)


def test_one_file_a_buffer(tmp_path):
    """ExtraNet's dump: Unreal's axes and signs, sky by its normal, files of no interest beside."""
    one = np.ones((4, 6))

    def write(kind, number, r, g=None, b=None):
        planes = {"R": r * one, "G": (r if g is None else g) * one, "B": (r if b is None else b) * one}
        write_channels(tmp_path / f"Bunker{kind}.{number:04d}.exr", planes)

    for number in (10, 11):
        write("WorldPosition", number, 5, 6, 7)
        write("SceneDepth", number, 300)
        write("MotionVector", number, -3, 2, 0)
        for kind in ("MyStencil", "NoV", "BaseColor", "Roughness", "Metallic", "Specular", "FinalImage"):
            write(kind, number, 1)
        write("WorldNormal", number, np.where(np.arange(6) == 2, -1, 0), np.where(np.arange(6) == 2, -1, 1), -1)
    write("PreTonemapHDRColor", 10, 8)
    sequence = open_sequence(tmp_path, "unreal")
    assert sequence.numbers == (10, 11)
    assert sequence.rendered == {10}
    assert len(sequence.files(10)) == 10
    assert len(sequence.files(11)) == 9
    frame = sequence.load(11)
    np.testing.assert_array_equal(frame.motion[0, 0], [3, 2])
    np.testing.assert_array_equal(frame.position[0, 0], [5, 6, 7])
    np.testing.assert_array_equal(np.isinf(frame.depth), one * (np.arange(6) == 2) > 0)
    assert not frame.normal[:, 2].any()
    (tmp_path / "BunkerMotionVector.0011.exr").unlink()
    with pytest.raises(
        InputError, match=r"frame 11: no motion: .* in a file NAMEMotionVector\.NNNN\.exr \(a MotionVector .*found B, G, R"
    ):
        open_sequence(tmp_path / "Bunker.####.exr", "unreal").load(11)


def test_mitsuba_takes_motion_from_files_of_its_own(tmp_path):
    one = np.ones((4, 6))
    names = ["R", "G", "B", "normal.X", "normal.Y", "normal.Z", "depth.T", "nov.X", "albedo.R", "albedo.G", "albedo.B"]
    planes = dict.fromkeys([*names, "position.X", "position.Y", "position.Z"], one)
    write_channels(tmp_path / "render.0001.exr", planes)
    with pytest.raises(
        InputError, match=r"no motion: .*\(Mitsuba has no motion AOV: give --static camera where .*NAME_motion\.NNNN\.exr"
    ):
        open_sequence(tmp_path, "mitsuba", metallic=0, roughness=0.5)
    write_channels(tmp_path / "render_motion.0001.exr", {"X": 2 * one, "Y": 3 * one})
    sequence = open_sequence(tmp_path, "mitsuba", metallic=0, roughness=0.5)
    frame = sequence.load(1)
    np.testing.assert_array_equal(frame.motion[1, 1], [2, 3])
    np.testing.assert_array_equal(frame.position[1, 1], np.float32([100, 100, 100]))
    assert len(sequence.files(1)) == 2


def blender_channels(layer, value=1.0):
    names = "Combined.R Combined.G Combined.B Vector.X Vector.Y Normal.X Normal.Y Normal.Z Depth.Z Position.X Position.Y "
    names += "Position.Z IndexOB.X DiffCol.R DiffCol.G DiffCol.B nov.X roughness.X metallic.X"
    return {f"{layer}.{name}": value * np.ones((4, 6)) for name in names.split()}


@pytest.mark.parametrize("layer", ["ViewLayer", "my.own layer"])
def test_any_layer_name(tmp_path, layer):
    write_channels(tmp_path / "a.0001.exr", blender_channels(layer))
    frame = open_sequence(tmp_path, "blender").load(1)
    np.testing.assert_array_equal(frame.motion[0, 0], [1, -1])
    np.testing.assert_array_equal(frame.position[0, 0], [100, 100, 100])
    np.testing.assert_array_equal(frame.base_color[0, 0], [1, 1, 1])


def test_several_layers(tmp_path):
    """Blender's own name is preferred, a layer with fewer buffers is not; otherwise it must be said."""
    few = {f"A.Combined.{name}": np.ones((4, 6)) for name in "RGB"}
    write_channels(tmp_path / "a.0001.exr", blender_channels("b", 0.5) | few)
    assert open_sequence(tmp_path, "blender").load(1).metallic[0, 0] == 0.5
    write_channels(tmp_path / "a.0001.exr", blender_channels("A", 0.5) | blender_channels("ViewLayer", 0.25))
    assert open_sequence(tmp_path, "blender").load(1).metallic[0, 0] == 0.25
    write_channels(tmp_path / "a.0001.exr", blender_channels("b", 0.5) | blender_channels("c", 0.25))
    with pytest.raises(InputError, match=r"a\.0001\.exr: layers b, c all fit profile blender"):
        open_sequence(tmp_path, "blender")


@pytest.mark.parametrize("row_vectors", [True, False])
def test_world_to_camera(tmp_path, row_vectors):
    """It gives NoV its camera and turns ray lengths into depths; both ways of storing it are understood."""
    angle = 0.3
    rotation = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    eye = np.array([1.0, 2.0, -5.0])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ eye
    in_camera = np.array([0.5, -0.25, 4.0])
    position = rotation.T @ in_camera + eye
    planes = {f"position.{name}": np.full((4, 6), value) for name, value in zip("XYZ", position, strict=True)}
    planes |= {name: np.ones((4, 6)) for name in ("R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "normal.X", "normal.Y")}
    planes |= {"normal.Z": -np.ones((4, 6)), "depth.T": np.full((4, 6), np.linalg.norm(in_camera))}
    attributes = {"worldToCamera": (oiio.TypeDesc("matrix"), [float(x) for x in (matrix.T if row_vectors else matrix).ravel()])}
    write_parts(tmp_path / "a.0001.exr", (np.stack([*planes.values()], -1).astype(np.float32), tuple(planes), attributes))
    write_channels(tmp_path / "a_motion.0001.exr", {"X": np.ones((4, 6)), "Y": np.ones((4, 6))})
    frame = open_sequence(tmp_path, "mitsuba", metallic=0, roughness=0.5).load(1)
    assert np.abs(frame.depth - 4).max() <= 4 * 2.0**-20
    normal, view = np.array([1, 1, -1]) / math.sqrt(3), eye - position
    assert np.abs(frame.nov - normal @ view / np.linalg.norm(view)).max() <= 2.0**-20


def test_unreal_says_where_its_camera_was(tmp_path):
    one = np.ones((4, 6))
    planes = dict.fromkeys(("R", "G", "B"), one)
    for buffer, alternatives in load_profile("unreal-mrq").channels.items():
        if buffer not in ("color", "nov"):
            planes |= dict.fromkeys(alternatives[0], one)
    eye = {f"unreal/camera/curPos/{axis}": value for axis, value in zip("xyz", ("1.0", "1.0", "5.0"), strict=True)}
    write_channels(tmp_path / "a.0001.exr", planes, metadata=eye)
    frame = open_sequence(tmp_path, "unreal-mrq").load(1)
    assert np.abs(frame.nov - 1 / math.sqrt(3)).max() <= 2.0**-20
    np.testing.assert_array_equal(frame.motion[0, 0], [-6, 4])


def test_a_plane_in_whole_numbers_is_told_by_its_type(write_frames):
    """In place of a number that no float holds. The numbers of objects may be whole."""
    folder = write_frames([1], size=(16, 24))
    path = folder / "seq.0001.exr"
    planes = read_channels(path, read_header(path).channels)
    for whole in ("basecolor.G", "stencil.X"):
        others = tuple(name for name in planes if name != whole)
        pixels, bits = np.stack([planes[name] for name in others], axis=-1), planes[whole][..., None].astype(np.uint32)
        write_parts(path, (pixels, others, {}), (bits, (whole,), {}))
        if whole == "stencil.X":
            np.testing.assert_array_equal(open_sequence(folder, "stss").load(1).stencil, planes[whole])
        else:
            with pytest.raises(
                InputError, match=r"channel basecolor\.G: base_color is stored in whole numbers \(uint\); expected float or half"
            ):
                open_sequence(folder, "stss")
