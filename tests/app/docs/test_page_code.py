"""Pages for programmers are right: blocks of Python, code in running text, tables of profiles.md; on data with that property.

Blocks run as they stand. `CELLS` and `KEYS` name all code in running text and all keys, so a page cannot contain untested code.
"""

import math
import re
import shlex
import stat
import sys
import tempfile
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pyopencl as cl
import pytest

import stss
from conformance.scenes import DEMO, render
from stss.frames.accumulation import Accumulation, accumulate_arrays
from stss.frames.display_frame import make_display_frame
from stss.images.color import transfer
from stss.images.headers import MAX_BYTES, MAX_CHANNELS, MAX_SIDE
from stss.images.read_write import write_channels
from stss.sequence.conventions import linear_depth, motion_in_pixels, world_normal
from stss.sequence.profiles import BUFFERS, DepthRule, profile_names
from stss_ground.errors import InputError
from stss_ref.weights import Weights
from stss_ref.weights import random as random_weights
from tests.cl import films
from tests.test_api import names

ROOT = Path(__file__).parents[3]
PAGES = [page for page in sorted(ROOT.rglob("*.md")) if not {".venv", ".venv-lowest", "node_modules"} & {*page.parts}]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.M | re.S)
CODE = [(str(page.relative_to(ROOT)), match[1]) for page in PAGES for match in BLOCK.finditer(page.read_text(encoding="utf-8"))]
SIZE = 16, 24


def page(name):
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def prose(name):
    return re.sub(r"^```.*?^```", "", page(name), flags=re.M | re.S)


def table_of(name, first):
    """The rows of a page's table whose first column has this head."""
    return re.search(rf"^\| {first} \|[^\n]*\n\|[-|]*\n((?:\|[^\n]*\n)*)", page(name), re.M)[1].splitlines()


def right(number):
    """A display frame in the conventions of the specification, float64; the even ones are rendered."""
    view = render(DEMO, number, *SIZE)
    planes = {field.name: getattr(view, field.name) for field in fields(view)}
    planes["position"] = np.where(np.isfinite(view.depth)[..., None], view.position, 1e7)
    return planes if number % 2 == 0 else {name: plane for name, plane in planes.items() if name != "color"}


def world_to_camera(number):
    """(4, 4) in metres, x right, y down, z ahead."""
    view = DEMO.camera.view(number, SIZE)
    matrix, axes = np.eye(4), np.stack([view.right, view.down, view.forward])
    matrix[:3, :3], matrix[:3, 3] = axes, -axes @ view.position[:, 0] / 100
    return matrix


def engine(number):
    """The same as the block of engines.md has it: motion in UV from the previous place, metres, a reversed infinite depth buffer."""
    planes = right(number)
    planes["motion"] = -planes["motion"] / (SIZE[1], SIZE[0])
    planes["position"] = planes["position"] / 100
    planes["depth"] = 0.1 / (planes["depth"] / 100)
    return {name: plane for name, plane in planes.items() if name != "nov"}


def buffers(number):
    planes = {name: plane.astype(np.float32) for name, plane in right(number).items()}
    return stss.Buffers(number, planes.pop("color", None), **planes)


def of_engines(device, demo, folder):
    def after(scope):
        loop, plain = scope["loop"], stss.Supersampler("realtime")
        for number in range(4):
            expected, converted = (
                buffers(number),
                stss.convert(number, engine(number), scope["rules"], camera=world_to_camera(number)),
            )
            for name in BUFFERS:
                one, other = getattr(converted, name), getattr(expected, name)
                one = 100 * one if name == "depth" else one  # any unit: metres here
                if other is None:
                    assert one is None, name
                    continue
                both = np.isfinite(one) & np.isfinite(other)
                assert (both == np.isfinite(other)).all(), name
                # float32 rounds what is stored and what is computed: four roundings; NoV also the camera, 10 m away, to 1e-6 of it.
                assert (np.abs(one[both] - other[both]) <= 2**-21 * np.maximum(np.abs(other[both]), 1)).all(), name
            image = scope["frame"](number, engine(number), world_to_camera(number), number == 2)
            want = plain.push(replace(expected, cut=number == 2)).image
            assert np.abs(image - want).max() < 2**-16, number  # measured 2**-22: what was rounded, through the network
        loop.reset()
        assert scope["frame"](5, engine(5), world_to_camera(5), False) is None

    return {}, after


def of_sequences(device, demo, folder):
    (folder / "frames").symlink_to(demo / "frames")
    return {}, lambda scope: None


def of_some_frames(device, demo, folder):
    return {"frames": [buffers(number) for number in range(4)]}, lambda scope: scope["level"] in ("note", "warning")


def of_frames(device, demo, folder):
    inputs = films.frame_inputs(SIZE)
    color, gbuffer, mask, history = films.network_inputs(SIZE)
    values = {"color": color, "gbuffer": gbuffer, "mask": mask, "history": history, "steps": inputs.steps}
    values |= {name: getattr(inputs, name) for name in ("colors", "motions", "nov", "stencils", "normals", "positions")}

    def after(scope):
        assert scope["image"].shape == (2 * SIZE[0], 2 * SIZE[1], 3)
        assert scope["valid"].shape == SIZE

    return values, after


def of_wrapped_buffers(device, demo, folder):
    window, steps = films.calls_of(films.film(6 * ["moving"], SIZE))[6]
    buffer = cl.Buffer(device.context, cl.mem_flags.COPY_HOST_PTR | cl.mem_flags.READ_WRITE, hostbuf=window[-1].gbuffer)
    theirs = np.empty((2 * SIZE[0], 2 * SIZE[1], 3), np.float32)
    values = {"handle": device.handle, "context": device.context, "queue": device.queue, "buffer": buffer, "window": window}
    values |= {"height": SIZE[0], "width": SIZE[1], "steps": steps, "theirs": theirs}

    def after(scope):
        assert scope["image"] is theirs
        films.assert_same((scope["gbuffer"].get(), scope["valid"]), (window[-1].gbuffer, scope["valid"]))

    return values, after


def of_images(device, demo, folder):
    image, before, two_before = np.random.default_rng(0).random((3, 2 * SIZE[0], 2 * SIZE[1], 3), np.float32)
    window = films.film(3 * ["moving"], SIZE)

    def after(scope):
        motions = [window[-1].motion, window[-2].motion]
        np.testing.assert_array_equal(scope["shown"], accumulate_arrays(image, [before, two_before], motions))

    return {"image": image, "image_before": before, "image_two_before": two_before, "window": window, "device": device}, after


def of_frames_ahead(device, demo, folder):
    images = []
    return {"calls": films.calls_of(films.film(4 * ["moving"], SIZE))[1:], "show": images.append}, lambda scope: len(images) == 4


def of_blender(device, demo, folder):
    """A stand-in; tests/app/blender runs the block in Blender."""
    sys.modules["bpy"] = bpy = MagicMock()
    del device, demo, folder

    def after(scope):
        del sys.modules["bpy"], scope["bpy"]
        bpy.ops.stss.render.assert_called_once_with()

    return {}, after


def of_ports(device, demo, folder):
    (folder / "my_port").write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m stss port --backend ref "$1"\n')
    (folder / "my_port").chmod(stat.S_IRWXU)
    return {}, lambda scope: None


NEEDS = {
    "rules = stss.load_profile": of_engines,
    'frames = stss.open_sequence("frames/")': of_sequences,
    "stss.check_frames(frames)": of_some_frames,
    "net = Network(weights)": of_frames,
    "gbuffer = cla.Array": of_wrapped_buffers,
    "Stream(weights).frames(calls)": of_frames_ahead,
    "accumulate = Accumulate(device)": of_images,
    "write_job(Path(": of_ports,
    "import bpy": of_blender,
}
"""A part of a block -> the data of its reader, and the property that must hold then."""


@pytest.mark.parametrize("name", sorted({name for name, _ in CODE}))
def test_blocks_run_as_they_stand(name, device, demo, tmp_path, monkeypatch):
    """One after the other, as by a reader who starts at the beginning of the page."""
    monkeypatch.chdir(tmp_path)
    scope = {"weights": random_weights(0)}
    for block in [block for where, block in CODE if where == name]:
        values, after = next(
            (need(device, demo, tmp_path) for words, need in NEEDS.items() if words in block), ({}, lambda _: None)
        )
        scope |= values
        exec(compile(block, name, "exec"), scope)
        assert after(scope) in (None, True), block


@pytest.mark.parametrize("name", profile_names())
def test_depth_of_any_kind_on_any_profile(name):
    device = stss.load_profile(name, depth={"kind": "device", "near": 0.1, "far": math.inf, "reversed": True}).depth
    assert device == DepthRule("device", math.inf, 0.1, math.inf, True)
    ray = stss.load_profile(name, depth={"kind": "ray"}).depth
    assert ray == replace(stss.load_profile(name).depth, kind="ray")
    with pytest.raises(InputError, match=r"depth\.near: expected a number > 0, found nothing"):
        stss.load_profile(name, depth={"kind": "device"})
    with pytest.raises(InputError, match=r"depth\.background: unknown key; known are kind, near, far, reversed"):
        stss.load_profile(name, depth={"kind": "device", "near": 1, "far": 2, "reversed": True, "background": 3})


def loop(**options):
    return stss.Supersampler("bilinear", backend="ref", **options)


def with_a_cut():
    outputs = [loop().push(replace(buffers(n), cut=n == 1)) for n in range(2)]
    return outputs[1] is None


def highlights_change_nothing_else():
    bright = replace(buffers(0), color=8 * buffers(0).color)
    assert loop().push(bright).image.max() > 1
    return loop(transfer="none").push(bright).image.max() == 1


def without_color():
    sequence = stss.open_sequence("frames/")
    assert sequence.rendered == {n for n in sequence.numbers if sequence.load(n).color is not None}
    return sequence.load(0, color=False).color is None


def forgets():
    one = loop()
    one.push(buffers(0))
    one.reset()
    return one.push(buffers(1)) is None


def mixed():
    alone, one = loop(), loop(accumulate=True)
    pairs = [(alone.push(buffers(n)).image, one.push(buffers(n)).image) for n in (0, 1)]
    return (pairs[0][0] == pairs[0][1]).all() and (pairs[1][0] != pairs[1][1]).any()


def unmixed():
    return not isinstance(stss.Supersampler("realtime", backend="ref", accumulate=False).backend, Accumulation)


def warm():
    loop().warm_up(SIZE)
    return True


CELLS = {
    "cut=True": with_a_cut,
    "loop.reset()": forgets,
    "reset()": forgets,
    "loop.warm_up((H, W))": warm,
    "warm_up((H, W))": warm,
    'stss.Supersampler("realtime").warm_up((540, 960))': warm,  # of other weights and size here; engines.md's block has these
    "accumulate=True": mixed,
    "Supersampler(accumulate=False)": unmixed,
    "memory_limit=": lambda: loop(memory_limit=1 << 30).push(buffers(0)) is not None,
    "tell=": None,  # tests/app/frames/test_backends.py
    'transfer="none"': highlights_change_nothing_else,
    "copy=False": lambda: loop(copy=False).push(buffers(0)) is not None,
    ".load(number)": without_color,
    "frames.load(number, color=False)": without_color,
    "push(buffers)": lambda: loop().push(buffers(0)).kind.value == "SF",
    "check(buffers)": lambda: stss.check(buffers(0)) is None,
    "convert(number, planes, profile)": lambda: stss.convert(0, right(0), "stss").color is not None,
    'load_profile("stss", units_per_cm=0.01, motion={"unit": "ndc", "y": "up"})': lambda: (
        stss.load_profile("stss", units_per_cm=0.01, motion={"unit": "ndc", "y": "up"}).motion.direction == "to_previous"
    ),
    'open_backend("cl" or "ref", weights, ...)': lambda: (
        stss.Supersampler(backend=stss.open_backend("ref", "bilinear")) is not None
    ),
    'Weights(arrays, "detail", "footprint", "reshade")': lambda: (
        Weights({}, "detail", "footprint", "reshade") == replace(stss.load_weights("realtime").weights, tensors={})
    ),
    "run(stage, inputs, weights)": None,  # tests/meta: every port
    "stages()": None,
    "(stored - bias) * scale": None,  # below, by key
    "motion = (X, -Y)": None,  # below, by profile
    "motion = (-R, G)": None,
    "motion = (-(R - 0.5) 2 W, (G - 0.5) 2 H)": None,
    'motion = "MotionVector"': None,  # tests/app/sequence/test_sequence.py: test_one_file_a_buffer
    "j(t)": None,  # examples/engine_loop.py, whose jitter is this
    "j(t - 1) - j(t)": None,
    "2 j(t)": None,
    "Texture.mipMapBias = -1": None,  # other programs' code
    "row += mv.y": None,
    "column -= mv.x": None,
    'aovs = "depth:depth, position:position, normal:sh_normal, albedo:albedo"': None,
}
"""Code in running text of the three pages -> whether it does what the text says; None: another test, or another program's code."""


def test_code_in_running_text(demo, tmp_path, monkeypatch):
    (tmp_path / "frames").symlink_to(demo / "frames")
    monkeypatch.chdir(tmp_path)
    text = " ".join(" ".join(map(prose, ("engines.md", "api.md", "profiles.md"))).split())
    assert {cell for cell in re.findall(r"`([^`]+)`", text) if re.search(r"[(=]", cell)} == CELLS.keys()
    for cell, holds in CELLS.items():
        assert holds is None or holds(), cell


def test_memory_that_a_loop_keeps():
    one = make_display_frame(buffers(0), transfer("srgb"), "scale")
    size = sum(getattr(one, field.name).nbytes for field in fields(one) if field.name not in ("number", "carried"))
    assert f"{size // (SIZE[0] * SIZE[1])} bytes a pixel are kept for each of six frames" in " ".join(page("api.md").split())


@pytest.mark.parametrize("missing", BUFFERS)
def test_planes_of_an_engine(missing):
    """The table of engines.md: its names, which may be left out, which may be one number."""
    rows = {name: row for row in table_of("engines.md", "plane") for name in re.findall(r"`(\w+)`", row.split("|")[1])}
    assert rows.keys() == BUFFERS.keys()
    planes = {name: plane for name, plane in right(0).items() if name != missing}
    camera = world_to_camera(0)[:3, :3].T @ -world_to_camera(0)[:3, 3] * 100
    if "left out where" in rows[missing]:
        stss.check(stss.convert(0, planes, camera=camera))
    else:
        with pytest.raises(InputError, match=f"no {missing}"):
            stss.convert(0, planes, camera=camera)
    one_number = {**right(0), missing: 0.5}
    if "or one number" in rows[missing]:
        assert (getattr(stss.convert(0, one_number), missing)[np.isfinite(right(0)["depth"])] == 0.5).all()
    elif missing != "depth":
        with pytest.raises(InputError, match=f"{missing}: expected shape"):
            stss.convert(0, one_number)


def test_a_camera_may_be_a_place_or_a_matrix_of_either_kind():
    """Engines of row vectors have the transpose, from which the camera once was at the origin."""
    planes = {name: plane for name, plane in right(0).items() if name != "nov"}
    matrix = world_to_camera(0)
    matrix[:3, 3] *= 100
    place = -matrix[:3, :3].T @ matrix[:3, 3]
    one, *others = (
        stss.convert(0, planes, camera=camera).nov
        for camera in (place, matrix, matrix.T, np.linalg.inv(np.linalg.inv(np.float32(matrix))))
    )
    assert all(np.abs(other - one).max() < 1e-6 for other in others)


@pytest.mark.parametrize("transpose", [False, True])
def test_a_pure_rotation_is_for_column_vectors(transpose):
    """A matrix without a translation may be of either kind; its axes, which planar depth needs, are those that pages promise."""
    planes = {name: plane for name, plane in right(0).items() if name != "nov"}
    camera = np.eye(4)[[1, 2, 0, 3]]
    rules = stss.load_profile("stss", depth={"kind": "ray"})
    depth = stss.convert(0, planes, rules, camera=camera.T if transpose else camera).depth
    hit = np.isfinite(depth)
    # The third row is the axis of the camera: x, or y of the transpose.
    along = np.abs(planes["position"][..., 1 if transpose else 0][hit])
    assert np.abs(depth[hit] - along).max() <= 1e-5 * along.max()


@pytest.mark.parametrize("camera", [np.zeros((4, 4)), np.full(3, np.nan), np.zeros((3, 4)), np.eye(4)[[0, 1, 3, 2]]])
def test_a_camera_that_is_none_is_refused(camera):
    with pytest.raises(InputError, match="camera: expected"):
        stss.convert(0, {name: plane for name, plane in right(0).items() if name != "nov"}, camera=camera)


def one_pixel(value, channels):
    return np.full((1, 1, channels), value, np.float32)


def motion(**change):
    """Pixels of a stored (1, 1) in an image of one pixel."""
    return motion_in_pixels(one_pixel(1, 2), stss.load_profile("stss", motion=change).motion)[0, 0].tolist()


def depth(value, **change):
    return float(linear_depth(np.float32([[value]]), stss.load_profile("stss", depth=change).depth)[0, 0])


KEYS = {
    "name": lambda: stss.load_profile("stss", name="mine").name == "mine",
    "title": lambda: stss.load_profile("stss", title="Mine").title == "Mine",
    "units_per_cm": lambda: (
        stss.convert(0, engine_of(units_per_cm=0.01), stss.load_profile("stss", units_per_cm=0.01)) is not None
    ),
    "color_domain": lambda: stss.load_profile("stss", color_domain="display").color_domain == "display",
    "depth_normalisation": lambda: stss.load_profile("stss", depth_normalisation="scale").depth_normalisation == "scale",
    "[channels]": lambda: stss.load_profile("stss", channels={"nov": []}).channels["nov"] == (),
    "[motion]": lambda: (
        motion(unit="pixels") == motion(unit="uv") == [1, 1]
        and motion(unit="ndc") == [0.5, 0.5]
        and motion(direction="from_previous") == [-1, -1]
        and motion(y="up") == [1, -1]
        and motion(bias=[0.5, 0.25], scale=[2, 4]) == [1, 3]
    ),
    "[depth]": lambda: (
        depth(5, kind="planar") == depth(5, kind="ray") == 5
        and depth(5, background=5) == depth(0) == depth(-1) == depth(np.nan) == math.inf
        and depth(1, kind="device", near=0.5, far=math.inf, reversed=True) == 0.5
        and depth(0.25, kind="device", near=0.5, far=math.inf, reversed=True) == 2
        and depth(0, kind="device", near=0.5, far=64, reversed=False) == 0.5
        and depth(1, kind="device", near=0.5, far=64, reversed=False) == math.inf
    ),
    "[normal]": lambda: (
        world_normal(one_pixel(1, 3), replace(stss.load_profile("stss").normal, bias=0.5, scale=2))[0].tolist() == [[[1, 1, 1]]]
    ),
    "base": lambda: loaded('base = "mitsuba"\nunits_per_cm = 2').depth.kind == "ray",
    "view": lambda: stss.load_profile("blender", view="right").view == "right",
    "[files]": lambda: stss.load_profile("stss", files={"motion": "MV"}).files_of("motion") == ("MV",),
    "[camera]": lambda: stss.load_profile("stss", camera={"attributes": [["x", "y", "z"]]}).camera == (("x", "y", "z"),),
    "[constants]": lambda: stss.load_profile("stss", constants={"stencil": 0}).constants == {"stencil": 0},
    "[hints]": lambda: stss.load_profile("stss", hints={"motion": "turn it on"}).hints == {"motion": "turn it on"},
}


def engine_of(units_per_cm):
    return {**right(0), "position": right(0)["position"] * units_per_cm}


def loaded(text):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mine.toml"
        path.write_text(text)
        return stss.load_profile(path)


def test_the_profile_of_the_page_is_that_of_the_engines_page():
    """One engine's conventions as a file and as a call."""
    section = page("profiles.md").split("## A profile of your own")[1]
    file = loaded(re.search(r"```toml\n(base.*?)```", section, re.S)[1])
    assert file.channels["stencil"] == (("id.red",), ("ObjectId",))
    place = {}
    exec(re.search(r"import math\n\nimport stss\n\nrules = .*?\n\)", page("engines.md"), re.S)[0], place)
    own = place["rules"]
    assert replace(own, name=file.name, title=file.title, path=file.path, channels=file.channels) == file
    assert {n: file.channels[n] for n in own.channels if n not in ("normal", "stencil")}.items() <= own.channels.items()


def test_the_profile_for_two_renders_of_mitsuba(tmp_path):
    """The colour of a file of its own, not that of the AOVs' only sample; a frame without such a file was not rendered."""
    own = loaded(re.search(r"```toml\n(base.*?)```", page("profiles.md").split("### `mitsuba`")[1], re.S)[1])
    names = [
        "normal.X",
        "normal.Y",
        "normal.Z",
        "depth.T",
        "nov.X",
        "albedo.R",
        "albedo.G",
        "albedo.B",
        "position.X",
        "position.Y",
    ]
    for number in (1, 2):
        planes = dict.fromkeys(["R", "G", "B", *names, "position.Z"], np.ones((4, 6), np.float32))
        write_channels(tmp_path / f"shot.{number:04d}.exr", planes)
    write_channels(tmp_path / "shot_color.0002.exr", dict.fromkeys("RGB", np.full((4, 6), 0.5, np.float32)))
    sequence = stss.open_sequence(tmp_path, own, roughness=0.5, metallic=0, static="camera")
    assert sequence.rendered == {2}
    assert (sequence.load(1, color=False).color, sequence.first.sources["normal"].path.name) == (None, "shot.0001.exr")
    assert sequence.frames[2].sources["color"].path.name == "shot_color.0002.exr"


def test_keys_of_a_profile():
    """The page has all keys, and each does what the page says."""
    section = page("profiles.md").split("## Keys")[1].split("\n## ")[0]
    rows = {
        key: row for row in section.splitlines() if row.startswith("| `") for key in re.findall(r"`([^`]+)`", row.split("|")[1])
    }
    with pytest.raises(InputError, match=r"nothing: unknown key") as error:
        stss.load_profile("stss", nothing=1)
    keys, tables = re.search("known are (.*) and the tables ([^;]*)", str(error.value)).groups()
    assert {*keys.split(", "), *(f"[{name}]" for name in tables.split(", "))} == rows.keys() == KEYS.keys()
    for key, holds in KEYS.items():
        assert holds(), key
    words = {
        key: set(re.findall(r"`(\w+)`", rows[key])) for key in ("[motion]", "[depth]", "color_domain", "depth_normalisation")
    }
    assert words["[motion]"] > {"pixels", "uv", "ndc", "to_previous", "from_previous", "up", "down"}
    assert words["[depth]"] > {"planar", "ray", "device", "background", "near", "far", "reversed"}
    assert words["color_domain"] > {"linear", "display"}
    assert words["depth_normalisation"] > {"clip", "scale"}


def test_buffers_and_limits_of_a_sequence():
    counts = {}
    for row in table_of("profiles.md", "buffer"):
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        counts |= dict(zip(re.findall(r"`(\w+)`", cells[0]), map(int, (cells[1].split(", ") * 3)), strict=False))
    assert counts == BUFFERS
    text = " ".join(prose("profiles.md").split())
    assert f"more than {MAX_SIDE} pixels a side, {MAX_CHANNELS} channels or {MAX_BYTES >> 30} GiB of pixels" in text


def section_of(name):
    assert f"\n### `{name}`\n" in page("profiles.md"), f"docs/profiles.md: expected a section ### `{name}`"
    return page("profiles.md").split(f"### `{name}`\n")[1].split("\n###")[0].split("\n## ")[0]


@pytest.mark.parametrize("name", profile_names())
def test_what_the_page_says_of_a_built_in_profile(name):
    """Formula of motion, background and kind of depth, unit of length, names: those of the file."""
    profile, text = stss.load_profile(name), " ".join(section_of(name).split())
    height, width = 20, 40
    if formula := re.search(r"`motion = \((.*), (.*)\)`", text):
        scope = {"X": 0.3, "Y": 0.7, "R": 0.3, "G": 0.7, "W": width, "H": height}
        want = [eval(re.sub(r"(?<=[\d)]) (?=[\dWH])", " * ", half), {}, scope) for half in formula.groups()]
        values = np.broadcast_to(np.float32([0.3, 0.7]), (height, width, 2))
        assert np.abs(motion_in_pixels(values, profile.motion)[0, 0] - want).max() < 1e-5
    if background := re.search(r"background (?:of )?(1e10|65504)|(65504), half's", text):
        assert profile.depth.background <= float(background[1] or background[2])
    assert ("distance along the ray" in text) == (profile.depth.kind == "ray")
    if unit := re.search(r"1 unit = 1 (c?m)", text):
        assert profile.units_per_cm == {"m": 0.01, "cm": 1}[unit[1]]
    if triple := re.search(r"\((-1, -1, -1)\) is sky", text):
        assert profile.normal.background == tuple(map(float, triple[1].split(",")))
    if name == "unreal":
        assert set(re.findall(r"`(\w+)`", re.search(r"\| names \| ([^|]*)", text)[1])) == profile.endings - {""}
    if name == "stss":
        listed = []
        for group in re.findall(r"`[^`]+`(?:, `[^`]+`)*(?=[;. ])", text.split("All")[0])[: len(BUFFERS)]:
            first, *others = re.findall(r"`([^`]+)`", group)
            listed.append([first, *(first[: first.rindex(".")] + other if other[0] == "." else other for other in others)])
        assert listed == [list(alternatives[0]) for alternatives in profile.channels.values()]


def test_names_of_the_api():
    """The other packages' names are compared in tests/test_api.py; here what an output and `Buffers` have."""
    output = loop().push(buffers(0))
    sentence = re.search(r"An output has (.*?)\. You may change", " ".join(prose("api.md").split()))[1]
    assert set(re.findall(r"`(\w+)`", sentence)) == {field.name for field in fields(output)}
    assert names("stss")


def test_materials_of_unreal_are_those_that_its_profile_reads():
    """The names in the page's list of steps."""
    profile, text = stss.load_profile("unreal-mrq"), section_of("unreal-mrq")
    materials = set(re.findall(r"`(\w+)`", re.search(r"2\. Six materials(.*?)\*\*Do not", text, re.S)[1]))
    own = {"normal", "position", "stencil", "base_color", "roughness", "metallic"}
    assert materials == {profile.channels[buffer][-1][0].removeprefix("FinalImage").removesuffix(".R") for buffer in own}
    engine = set(re.findall(r"\*(MovieRenderQueue_\w+)\*", text))
    assert engine == {profile.channels[b][0][0].removeprefix("FinalImage").removesuffix(".R") for b in ("motion", "depth")}
