"""Profiles: each convention spelled out, each mistake in a file named."""

import re
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
from click.testing import CliRunner

from stss.cli.main import stss
from stss.images.read_write import write_channels
from stss.sequence.conventions import linear_depth, motion_in_pixels
from stss.sequence.profiles import BUFFERS, DepthRule, load_profile, profile_names
from stss.sequence.reader import open_sequence
from stss_ground.errors import InputError
from tests.app.conftest import write_parts


def toml(name="stss"):
    return load_profile(name).path.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", profile_names())
def test_built_in_profiles_load(name):
    profile = load_profile(name)
    assert profile.name == name == profile.path.stem
    assert set(profile.channels) == set(BUFFERS)


def write_shot(folder, name):
    """Two frames as the renderer of a built-in profile writes them, by the first names that the profile has."""
    profile, files = load_profile(name), {}
    for buffer, (names, *_) in profile.channels.items():
        ending = profile.files_of(buffer)[0]
        files.setdefault(ending, {}).update({each.replace("{layer}", "ViewLayer"): np.ones((4, 4)) for each in names})
    for number in (1, 2):
        for ending, channels in files.items():
            write_channels(folder / f"shot{ending}.{number:04d}.exr", channels)


@pytest.mark.parametrize("name", profile_names())
def test_the_files_of_a_built_in_profile_choose_it(tmp_path, name):
    """Alone: a new profile with the names of another one would leave the users of both without a choice."""
    write_shot(tmp_path, name)
    assert open_sequence(tmp_path).profile.name == name


@pytest.mark.parametrize("name", profile_names())
def test_another_profile_than_that_of_the_files_is_one_short_line(tmp_path, name):
    """It names both; the hints of the wrong one, which lead nowhere, are left out."""
    write_shot(tmp_path, name)
    for wrong in set(profile_names()) - {name}:
        for words in (["run", "-o", str(tmp_path / "out")], ["check"]):
            said = CliRunner().invoke(stss, [*words, str(tmp_path), "--profile", wrong], catch_exceptions=True)
            text = str(said.exception) if words[0] == "run" else said.output.splitlines()[0]
            assert re.search(rf"profile {wrong}(?!-).*profile {name}\b", text), text
            assert len(text.replace(str(tmp_path), "")) < 200


@pytest.mark.parametrize(("wrong", "near"), [
    ("blener", "blender or blender-files"), ("Unreal_MRQ", "unreal-mrq or unreal"), ("vray", None), ("blender.tom", "blender"),
])  # fmt: skip
def test_a_profile_that_is_not_there_is_told_its_like(wrong, near):
    with pytest.raises(InputError) as error:
        load_profile(wrong)
    assert str(error.value).startswith(f"profile {wrong}: expected one of blender, ")
    assert str(error.value).partition("; did you mean ")[2] == (f"{near}?" if near else "")


@pytest.mark.parametrize("count", [20, 1000])
def test_many_missing_buffers_are_one_short_line(tmp_path, count):
    """With names of the renderer's own, and as many channels as a file with all of its light groups has."""
    names = ["ViewLayer.Combined.R", "ViewLayer.Combined.G", "ViewLayer.Combined.B", "ViewLayer.Vectors.X", "ViewLayer.Vectors.Y"]
    write_channels(tmp_path / "a.0001.exr", {n: np.ones((4, 4)) for n in (*names, *(f"light{i}.W" for i in range(count)))})
    with pytest.raises(InputError) as error:
        open_sequence(tmp_path, "blender")
    text = str(error.value).replace(str(tmp_path), "")
    assert "no motion: profile blender expects {layer}.Vector.X, .Y (turn on the Vector pass" in text
    assert "; did you mean Vectors.X or Vectors.Y?" in text
    assert "; no position, stencil, base_color, roughness, metallic either: stss check explains each; found " in text
    assert len(text) < 900
    lines = CliRunner().invoke(stss, ["check", str(tmp_path), "--profile", "blender"]).output.splitlines()
    assert [line.split()[2].rstrip(":") for line in lines if line.startswith("error: no ")] == [
        "motion", "normal", "depth", "position", "stencil", "base_color", "roughness", "metallic",
    ]  # fmt: skip
    assert max(map(len, lines)) < 500


def test_a_profile_from_windows_is_read(tmp_path):
    """Its editors begin a text in UTF-8 with a mark, and end lines with two characters."""
    (tmp_path / "mine.toml").write_bytes(b'\xef\xbb\xbfbase = "stss"\r\nunits_per_cm = 0.01\r\n')
    assert load_profile(tmp_path / "mine.toml").units_per_cm == 0.01


def test_a_profile_is_a_file_like_any_other(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(toml("blender").replace('name = "blender"', 'name = "mine"').replace("0.01 ", "1 "), encoding="utf-8")
    mine, blender = load_profile(path), load_profile("blender")
    assert (mine.name, mine.units_per_cm, blender.units_per_cm) == ("mine", 1, 0.01)
    assert mine.channels == blender.channels


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("units_per_cm = 1", "", "units_per_cm: expected a number > 0, found nothing"),
        ("units_per_cm = 1", "units_per_cm = 0", "units_per_cm: expected a number > 0, found 0"),
        ("units_per_cm = 1", "units_per_cm = 1\nunits = 2", "units: unknown key; known are name, title"),
        ('"linear"', '"srgb"', "color_domain: expected one of linear, display, found 'srgb'"),
        ('y = "down"', "", "motion.y: expected one of up, down, found nothing"),
        ("scale = [1, 1]", "scale = [1, nan]", "motion.scale: expected 2 numbers, found [1, nan]"),
        ('[["motion.X", "motion.Y"]]', '[["motion.X"]]', "channels.motion: expected a list of lists of 2 names"),
        ("nov =", "NoV =", "channels.NoV: unknown key; known are color, motion"),
        ("[normal]", "[files]\nalbedo = 'x'\n[normal]", "files.albedo: unknown key; known are color, motion"),
        ("[normal]", "[constants]\nroughness = 'x'\n[normal]", "constants.roughness: expected a number, found 'x'"),
        ("[normal]", "[files]\nmotion = []\n[normal]", "files.motion: expected one line of text, or a list of them, found []"),
        ("[normal]", "[hints]\ndepth = ''\n[normal]", "hints.depth: expected one line of text, found ''"),
        ('kind = "planar"', 'kind = "device"', "depth.background: unknown key; known are kind, near, far, reversed"),
        ("bias = 0\nscale = 1", "bias = 0\nscale = 1\nspace = 'view'", "normal.space: unknown key"),
        ("[normal]", "[normal", "cannot be read as TOML"),
    ],
)
def test_each_mistake_is_named(tmp_path, old, new, message):
    text = toml()
    assert text.count(old) >= 1
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=r"mine\.toml: " + re.escape(message)) as error:
        load_profile(path)
    assert "\n" not in str(error.value)


def test_a_profile_may_say_only_what_it_changes(tmp_path):
    """As in `load_profile`: tables keep the entries that a change does not name, and the name is the file's."""
    path = tmp_path / "mine.toml"
    path.write_text(
        'base = "stss"\nunits_per_cm = 0.01\nmotion = {unit = "uv"}\ndepth = {kind = "device", near = 0.1, far = inf, reversed = true}'
    )
    mine = load_profile(path)
    assert (mine.name, mine.path, mine.title) == ("mine", path, "mine, changed from stss")
    changed = load_profile(
        "stss", units_per_cm=0.01, motion={"unit": "uv"}, depth={"kind": "device", "near": 0.1, "far": np.inf, "reversed": True}
    )
    assert replace(mine, name="stss", title=changed.title, path=changed.path) == changed
    assert load_profile(path, title="x", motion={"y": "up"}).motion == replace(mine.motion, y="up")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('base = "mine"', f"base: expected one of {', '.join(profile_names())}, found 'mine'"),
        ("base = 3", "base: expected one of blender"),
        ('base = "stss"\nunit = 1', "unit: unknown key; known are name, title, base"),
        ('base = "stss"\nmotion = {unit = "texels"}', "motion.unit: expected one of pixels, uv, ndc, found 'texels'"),
        ('base = "stss"\nmotion = 3', "motion: expected a table, found 3"),
        (
            'base = "stss"\ndepth = {kind = "device", near = 0.1, far = inf, reverse = true}',
            "depth.reverse: unknown key; known are kind, near, far, reversed; did you mean reversed?",
        ),
    ],
)
def test_a_change_of_a_file_that_is_wrong_is_named_by_the_file(tmp_path, text, message):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"mine\.toml: " + re.escape(message)):
        load_profile(path)


def test_a_change_of_a_call_that_is_wrong_blames_no_file():
    with pytest.raises(InputError, match=r"^profile stss as changed: motion\.unit: expected one of pixels"):
        load_profile("stss", motion={"unit": "texels"})


PASSES = {"Image": "RGB", "DiffCol": "RGB", "Normal": "XYZ", "Position": "XYZ", "Vector": "XYZW"}
VALUES = ("Depth", "IndexOB", "metallic", "roughness")
FILE_OUTPUT = [f"{of}.{letter}" for of, letters in PASSES.items() for letter in letters] + [f"{of}.V" for of in VALUES]
"""The channels of a file that the File Output node of Blender 4.5 writes, with the names that its sockets have by default."""
BLENDER_5 = {"Image": "Combined", "DiffCol": "Diffuse Color", "IndexOB": "Object Index", ".V": ".X", "Depth.X": "Depth.Z"}
"""How a render's passes are called in Blender 5, behind the layer's name."""


@pytest.mark.parametrize("layer", ["", "ViewLayer."])
def test_passes_are_found_by_the_names_of_every_blender(tmp_path, layer):
    names = FILE_OUTPUT
    for old, new in BLENDER_5.items() if layer else ():
        names = [name.replace(old, new) for name in names]
    write_channels(tmp_path / "a.0001.exr", {layer + name: np.ones((4, 4)) for name in names})
    sequence = open_sequence(tmp_path)
    assert sequence.profile.name == "blender"
    assert set(sequence.frames[1].sources) == set(BUFFERS) - {"nov"}


@pytest.mark.parametrize("name", ["stss", "blender"])
def test_upper_and_lower_case_are_told_apart_only_where_a_file_has_both(tmp_path, name):
    """Programs write ``r`` for ``R``. Where a file has both spellings, the profile's own is taken."""
    color, *others = (names for names, *_ in load_profile(name).channels.values())
    color, others = ([each.replace("{layer}", "ViewLayer") for each in names] for names in (color, sum(others, ())))
    lower = [each[:-1] + each[-1].lower() for each in color]
    write_channels(tmp_path / "a.0001.exr", {each: np.ones((4, 4)) for each in (*lower, lower[0][:-1] + "a", *others)})
    write_channels(tmp_path / "a.0002.exr", {each: np.ones((4, 4)) for each in (*lower, *color, *(n.lower() for n in others))})
    sequence = open_sequence(tmp_path)
    assert sequence.profile.name == name
    assert sequence.carries() == ("A",)
    assert [list(sequence.frames[n].sources["color"].names) for n in (1, 2)] == [lower, color]
    assert [set(sequence.frames[n].sources) for n in (1, 2)] == [set(BUFFERS)] * 2


@pytest.mark.parametrize(("start", "names"), [("", {}), ("file_name", {"DiffCol": "Diffuse Color", "IndexOB": "Object Index"})])
def test_a_file_for_each_pass_is_found_by_the_names_of_every_blender(tmp_path, start, names):
    """As Blender 4.5 and 5.0 write them by default. Without an AOV for the base colour its pass is taken."""
    for of, letters in {**PASSES, **dict.fromkeys(VALUES, "RGBA")}.items():
        write_channels(tmp_path / f"{start}{names.get(of, of)}0001.exr", {letter: np.ones((4, 4)) for letter in letters})
    sequence = open_sequence(tmp_path)
    assert sequence.profile.name == "blender-files"
    assert set(sequence.frames[1].sources) == set(BUFFERS) - {"nov"}


@pytest.mark.parametrize(("layers", "said"), [
    (["ViewLayer"], []),
    (["ViewLayer", "Back"], ["ViewLayer, Back"]),
    (["Front", "Composite"], ["Front, Composite"]),
])  # fmt: skip
def test_a_layer_read_alone_is_said(tmp_path, layers, said):
    """Blender's compositor writes a colour, too, which is not read."""
    names = [f"{layers[0]}.{name}" for name in FILE_OUTPUT] + [
        f"{layer}.Image.{letter}" for layer in layers[1:] for letter in "RGBA"
    ]
    if layers[1:] == ["Back"]:
        names += [f"Back.{name}" for name in FILE_OUTPUT if not name.startswith("Image")]
    names = [name.replace("Image", "Combined").replace(".V", ".X").replace("Depth.X", "Depth.Z") for name in names]
    names = [name.replace("Xector", "Vector") for name in names]
    write_channels(tmp_path / "a.0001.exr", {name: np.ones((4, 4)) for name in names})
    notes = open_sequence(tmp_path).notes
    assert [re.search("colour of (.*); only", note).group(1) for note in notes] == said
    assert all(f"; only {layers[0]} is read: " in note for note in notes)


def test_a_file_for_each_pass_is_found(tmp_path):
    """As the File Output node writes them by default; Alpha is nobody's buffer."""
    for of, letters in {**PASSES, **dict.fromkeys(("Alpha", *VALUES), "RGBA"), "basecolor": "RGBA"}.items():
        write_channels(tmp_path / f"{of}0001.exr", {letter: np.ones((4, 4)) for letter in letters})
    (tmp_path / "mine.toml").write_text('base = "blender-files"\nfiles = {base_color = "DiffCol"}')
    for profile, base_color in ((None, "basecolor0001.exr"), (tmp_path / "mine.toml", "DiffCol0001.exr")):
        sequence = open_sequence(tmp_path, profile)
        assert sequence.profile.name == ("mine" if profile else "blender-files")
        assert set(sequence.frames[1].sources) == set(BUFFERS) - {"nov"}
        assert sequence.frames[1].sources["base_color"].path.name == base_color


def test_all_buffers_that_are_missing_are_said_at_once(tmp_path):
    """An artist who adds one pass and renders again must not hear of a second missing one then."""
    names = [n for n in FILE_OUTPUT if not n.startswith(("metallic", "roughness", "IndexOB"))]
    write_channels(tmp_path / "a.0001.exr", {n: np.ones((4, 4)) for n in names})
    with pytest.raises(InputError) as error:
        open_sequence(tmp_path)
    assert re.findall(r"no (\w+): profile blender expects", str(error.value)) == ["stencil", "roughness", "metallic"]
    for words in ("turn on the Object Index pass", "--roughness 0.5", "--metallic 0", "found Depth.V, DiffCol.B"):
        assert words in str(error.value)


@pytest.mark.parametrize("stored", [np.float32, np.float16])
@pytest.mark.parametrize("background", [1e11, 1e12, 1e30, 12345.0, 5.001])
def test_a_background_is_known_as_the_file_rounds_it(background, stored):
    """1e12 is 999999995904 as a float, and 12345 is 12344 as a half: less than the number that the profile has."""
    rule = load_profile("stss", depth={"background": background}).depth
    with np.errstate(over="ignore"):
        depth = linear_depth(np.array([[stored(background), 0.99 * background, 1]], np.float32), rule)
    np.testing.assert_array_equal(depth, np.array([[np.inf, 0.99 * background, 1]], np.float32))


@pytest.mark.parametrize(
    ("name", "in_file", "motion"),
    [
        # The point came from 3 pixels right of and 2 pixels below where it is now, in an image 40 wide and 20 high.
        ("stss", (3, 2), (3, 2)),
        ("blender", (3, -2), (3, 2)),
        ("blender-files", (3, -2), (3, 2)),
        ("unreal", (-3, 2), (3, 2)),
        ("unreal-mrq", (0.5 - 3 / 80, 0.5 + 2 / 40), (3, 2)),
        ("mitsuba", (3, 2), (3, 2)),
    ],
)
def test_motion_of_every_profile(name, in_file, motion):
    """One displacement as each renderer writes it. The comparison is exact after rounding to thousandths of a pixel."""
    values = np.broadcast_to(np.array(in_file, dtype=np.float32), (20, 40, 2))
    pixels = motion_in_pixels(values, load_profile(name).motion)
    assert pixels.dtype == np.float32
    np.testing.assert_array_equal(np.rint(pixels * 1000), np.broadcast_to(np.array(motion) * 1000, (20, 40, 2)))


@pytest.mark.parametrize("reverse", [True, False])
@pytest.mark.parametrize("far", [64.0, np.inf])
def test_device_depth(reverse, far):
    """z = near at one end, far at the other, 1 / z linear between; the far plane is background."""
    z = np.array([[0.5, 1, 2, 8, 32]])
    values = (1 / z - 1 / far) / (1 / 0.5 - 1 / far)
    values = np.append(values, [[0]], axis=1)
    rule = DepthRule("device", np.inf, 0.5, far, reverse)
    depth = linear_depth((values if reverse else 1 - values).astype(np.float64), rule)
    np.testing.assert_array_equal(np.rint(depth[0, :5] * 1000), z[0] * 1000)
    assert np.isinf(depth[0, 5])


def test_a_profile_file_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"mine\.toml: no such file"):
        load_profile(tmp_path / "mine.toml")


def test_two_layers_without_a_profile_are_named(tmp_path):
    """Blender's view layers BG and FG: the error is the one that --profile blender gives."""
    names = [n for of in load_profile("blender").channels.values() for n in of[0]]
    for number in (1, 2):
        channels = {n.replace("{layer}", layer): np.ones((4, 4)) for layer in ("BG", "FG") for n in names}
        write_channels(tmp_path / f"a.{number:04d}.exr", channels)
    for profile in (None, "blender"):
        with pytest.raises(InputError, match=r"a\.0001\.exr: layers BG, FG all fit profile blender; write the layer's name"):
            open_sequence(tmp_path, profile)


def test_views_in_the_names_of_channels_are_found(tmp_path):
    """Blender's stereo files: LAYER.PASS.VIEW.CHANNEL."""
    names = [n.replace("{layer}", "ViewLayer") for of in load_profile("blender").channels.values() for n in of[0]]
    both = [f"{n.rpartition('.')[0]}.{view}.{n.rpartition('.')[2]}" for n in names for view in ("left", "right")]
    pixels = np.ones((4, 4, len(both)), np.float32)
    write_parts(tmp_path / "a.0001.exr", (pixels, tuple(both), {"multiView": (oiio.TypeDesc("string[2]"), ("left", "right"))}))
    sequence = open_sequence(tmp_path)
    assert (sequence.profile.name, set(sequence.frames[1].sources)) == ("blender", set(BUFFERS))
    assert sequence.frames[1].sources["depth"].names == ("ViewLayer.Depth.left.Z",)
    right = open_sequence(tmp_path, load_profile("blender", view="right"))
    assert right.frames[1].sources["depth"].names == ("ViewLayer.Depth.right.Z",)


def test_views_may_be_parts(tmp_path):
    """Blender's files of many views: a part ``LAYER.PASS-VIEW`` for each pass and view, their channels without the view."""
    passes = {names[0][0].rpartition(".")[0]: names[0] for names in load_profile("blender").channels.values() if names}
    parts = []
    for name, channels in passes.items():
        layer, names = name.replace("{layer}", "ViewLayer"), tuple(n.replace("{layer}", "ViewLayer") for n in channels)
        for value, view in enumerate(("left", "right"), 1):
            pixels = np.full((4, 4, len(names)), value, np.float32)
            parts.append((pixels, names, {"oiio:subimagename": (f"{layer}-{view}",), "view": (view,)}))
    write_parts(tmp_path / "a.0001.exr", *parts)
    sequence = open_sequence(tmp_path)
    assert sequence.notes == (
        'views: the files have left, right; only left is read: a profile with a base and view = "right" reads another',
    )
    assert (sequence.load(1).color == 1).all()
    right = open_sequence(tmp_path, load_profile("blender", view="right"))
    assert right.frames[1].sources["depth"].names == ("right.ViewLayer.Depth.Z",)
    assert (right.load(1).color == 2).all()


def test_a_part_may_hold_the_name_of_its_channels(tmp_path):
    """A frame that was not rendered has no part ``rgba``: its base colour, then the only R, G, B, is no picture."""
    parts = {"rgba": "RGB", "motion": "XY", "normal": "XYZ", "depth": "Z", "position": "XYZ", "stencil": "X", "nov": "X"}
    parts |= {"basecolor": "RGB", "roughness": "X", "metallic": "X"}
    filled = {name: np.full((4, 4, len(of)), value, np.float32) for value, (name, of) in enumerate(parts.items())}
    for number in (1, 2):
        kept = [name for name in parts if number == 1 or name != "rgba"]
        every = [(filled[name], tuple(parts[name]), {"oiio:subimagename": (name,)}) for name in kept]
        write_parts(tmp_path / f"a.{number:04d}.exr", *every)
    sequence = open_sequence(tmp_path)
    assert list(sequence.rendered) == [1]
    for number in (1, 2):
        frame = sequence.load(number)
        assert (frame.base_color == 1).all()  # 7, clipped
        assert (frame.stencil == 5).all()


def test_no_view_takes_what_another_one_has_alone(tmp_path):
    """As Nuke writes them: the first view without its name. The second has no depth of its own."""
    names = ["R", "G", "B", "depth.Z", "right.R", "right.G", "right.B"]
    attribute = oiio.TypeDesc("string[2]"), ("left", "right")
    write_parts(tmp_path / "a.0001.exr", (np.ones((4, 4, 7), np.float32), tuple(names), {"multiView": attribute}))
    with pytest.raises(InputError, match=r"no depth: profile stss expects depth\.Z"):
        open_sequence(tmp_path, load_profile("stss", view="right"))
    with pytest.raises(InputError) as error:
        open_sequence(tmp_path, load_profile("stss", view="left"))
    assert "no depth" not in str(error.value)
