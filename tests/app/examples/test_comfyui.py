"""The nodes for ComfyUI, called as it calls them: by class, with keywords, tensors in and tensors out."""

import importlib.util
import json
import os
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import stss
from stss.demo import demo_path
from stss.images.color import transfer
from stss.images.headers import read_header
from stss.images.read_write import read_channels, write_channels
from stss.images.windows import PixelWindow
from stss_ground.errors import InputError
from tests.app.conftest import frame_channels
from tests.app.images.test_windows import write as write_windows
from tests.app.sequence.test_background import hide, write_without_motion

PACK = Path(__file__).parents[3] / "examples" / "comfyui" / "__init__.py"


class Tensor:
    """The parts of PyTorch that nodes use, if PyTorch is not installed."""

    def __init__(self, array):
        self.array, self.shape = array, array.shape

    def cpu(self):
        """The tensor itself."""
        return self

    def numpy(self):
        """Its numbers."""
        return self.array

    def __getitem__(self, index):
        return Tensor(self.array[index])


@pytest.fixture
def nodes(monkeypatch):
    """As ComfyUI imports a folder of `custom_nodes`."""
    if importlib.util.find_spec("torch") is None:
        monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(from_numpy=Tensor))
    spec = importlib.util.spec_from_file_location("custom_nodes_stss", PACK, submodule_search_locations=[str(PACK.parent)])
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def all_inputs(node):
    """Those that a user may leave alone, too."""
    kinds = node.INPUT_TYPES()
    return kinds["required"] | kinds.get("optional", {})


def call(nodes, name, **inputs):
    """The outputs of a node; its inputs must be those that it declares, its outputs as many as it names."""
    node = nodes.NODE_CLASS_MAPPINGS[name]
    assert node.INPUT_TYPES()["required"].keys() <= inputs.keys() <= all_inputs(node).keys()
    for key, value in inputs.items():
        kind = all_inputs(node)[key][0]
        assert not isinstance(kind, list) or value in kind
    outputs = getattr(node(), node.FUNCTION)(**inputs)
    assert len(outputs) == len(node.RETURN_TYPES) == len(node.RETURN_NAMES)
    return outputs


def test_a_graph_of_both_nodes_makes_what_stss_makes(nodes, demo):
    assert nodes.NODE_CLASS_MAPPINGS.keys() == nodes.NODE_DISPLAY_NAME_MAPPINGS.keys()
    images, gbuffer = call(
        nodes, "StssLoadFrames", folder=str(demo / "frames"), profile="auto", background="files", first=0, count=4
    )
    assert tuple(images.shape) == (2, 18, 32, 3)
    assert images.numpy().min() >= 0
    assert images.numpy().max() <= 1
    assert gbuffer.rendered == (True, False, True, False)
    frames, holes = call(nodes, "StssSupersample", images=images, gbuffer=gbuffer, weights="bilinear", backend="ref")
    assert tuple(frames.shape) == (4, 36, 64, 3)
    assert tuple(holes.shape) == (4, 18, 32)
    sequence = stss.open_sequence(demo / "frames")
    loop = stss.Supersampler("bilinear", backend="ref")
    for index, number in enumerate(sequence.numbers):
        want = loop.push(sequence.load(number, color=number % 2 == 0))
        # Highlights above 1 end at 1 as images do; the transfer and back rounds twice.
        assert np.abs(frames.numpy()[index] - transfer("srgb").encode(np.minimum(want.image, 1))).max() < 2**-18
        np.testing.assert_array_equal(holes.numpy()[index] == 1, ~want.valid)
    assert holes.numpy()[1].any()
    assert frames.numpy().dtype == holes.numpy().dtype == np.float32


def test_the_background_moves_with_the_camera(nodes, demo):
    """The option reaches the sequence."""
    options = {"folder": str(demo / "frames"), "profile": "stss", "first": 0, "count": 2}
    moves = call(nodes, "StssLoadFrames", **options, background="camera")[1].frames[1].motion
    want = stss.open_sequence(demo / "frames", "stss", background="camera").load(1).motion
    np.testing.assert_array_equal(moves, want)
    assert (moves != stss.open_sequence(demo / "frames", "stss").load(1).motion).any()


def test_files_without_motion_and_material(nodes, tmp_path):
    """As Mitsuba's: the camera gives the motion, the node the constants; a part of a shot needs no camera of the frame before it."""
    folder = write_without_motion(tmp_path / "in", "pan")
    for number in range(5):
        path = demo_path(folder, number)
        planes = read_channels(path, read_header(path).channels)
        write_channels(path, {name: plane for name, plane in planes.items() if name not in ("roughness.X", "metallic.X")})
    options = {"folder": str(folder), "profile": "stss", "background": "files", "static": "camera", "first": 2, "count": 3}
    with pytest.raises(InputError, match="no roughness"):
        call(nodes, "StssLoadFrames", **options)
    constants = {"roughness": 0.5, "metallic": 0.0}
    want = stss.open_sequence(folder, "stss", static="camera", **constants).load(3)
    got = call(nodes, "StssLoadFrames", **options, **constants)[1].frames[1]
    assert np.array_equal(got.motion, want.motion)
    assert got.motion.any()
    assert got.roughness.max() == 0.5  # 0 where nothing was hit
    assert not got.metallic.any()
    hide(demo_path(folder, 1))
    again = call(nodes, "StssLoadFrames", **options, **constants)[1].frames[1]
    assert np.array_equal(again.motion, want.motion)
    (tmp_path / "camera.csv").write_text("frame,x,y,z\n" + "".join(f"{n},0,0,{n}\n" for n in range(5)))
    table = {"camera": f'"{tmp_path / "camera.csv"}"'}
    changed = nodes.NODE_CLASS_MAPPINGS["StssLoadFrames"].IS_CHANGED
    before = changed(**options, **table)
    assert before != changed(**options)
    nov = call(nodes, "StssLoadFrames", **options, **constants, **table)[1].frames[1].nov
    camera = stss.open_sequence(folder, "stss", static="camera", **constants, camera=tmp_path / "camera.csv")
    assert np.array_equal(nov, camera.load(3).nov)


def test_images_that_other_nodes_made_are_shown(nodes, demo):
    images, gbuffer = call(
        nodes, "StssLoadFrames", folder=str(demo / "frames"), profile="stss", background="files", first=1, count=2
    )
    assert gbuffer.rendered == (True, False)
    assert gbuffer.frames[0].number == 2
    grey = type(images)(np.full(images.shape, 0.25, np.float32)) if isinstance(images, Tensor) else images * 0 + 0.25
    frames, _ = call(nodes, "StssSupersample", images=grey, gbuffer=gbuffer, weights="bilinear", backend="ref")
    assert (frames.numpy() == 0.25).all()
    with pytest.raises(InputError, match=r"images: expected the 1 rendered frames, \(1, 18, 32, 3\); found \(0, 18, 32, 3\)"):
        call(nodes, "StssSupersample", images=images[:0], gbuffer=gbuffer, weights="bilinear", backend="ref")
    with pytest.raises(InputError, match="no rendered frame from 9 on"):
        call(nodes, "StssLoadFrames", folder=str(demo / "frames"), profile="stss", background="files", first=9, count=2)


def test_a_folder_as_it_is_pasted_and_a_frame_that_is_missing(nodes, demo, tmp_path):
    """A display frame that is left out without a word would shift all sound and motion behind it."""
    shutil.copytree(demo / "frames", tmp_path / "a b")
    options = {"folder": f'"{tmp_path / "a b"}"\n', "profile": "auto", "background": "files", "first": 0, "count": 4}
    assert call(nodes, "StssLoadFrames", **options)[1].rendered == (True, False, True, False)
    sorted((tmp_path / "a b").iterdir())[1].unlink()
    with pytest.raises(InputError, match="frame 1: not there"):
        call(nodes, "StssLoadFrames", **options)


def test_progress_and_files_that_changed(nodes, demo, monkeypatch):
    steps = []
    bar = SimpleNamespace(ProgressBar=lambda count: SimpleNamespace(update=steps.append))
    monkeypatch.setitem(sys.modules, "comfy", SimpleNamespace(utils=bar))
    monkeypatch.setitem(sys.modules, "comfy.utils", bar)
    options = {"folder": str(demo / "frames"), "profile": "auto", "background": "files", "first": 0, "count": 2}
    images, gbuffer = call(nodes, "StssLoadFrames", **options)
    call(nodes, "StssSupersample", images=images, gbuffer=gbuffer, weights="bilinear", backend="ref")
    assert steps == [1, 1, 1, 1]  # a user can stop both nodes after each frame
    changed = nodes.NODE_CLASS_MAPPINGS["StssLoadFrames"].IS_CHANGED
    assert changed(**options) == changed(**options) != ""


def test_a_frame_of_several_files_changed(nodes, demo, tmp_path):
    """Files named as the compositor of Blender names them: one for each buffer."""
    files = sorted((demo / "frames").iterdir())[:4]
    for file in files:
        number = file.stem.rsplit(".", 1)[1]
        for ending in ("Image", "Depth"):
            shutil.copyfile(file, tmp_path / f"{ending}{number}.exr")
    changed = nodes.NODE_CLASS_MAPPINGS["StssLoadFrames"].IS_CHANGED
    options = {"folder": str(tmp_path), "profile": "blender-files", "background": "files", "first": 0, "count": 2}
    before = changed(**options)
    assert before == changed(**options)
    path = max(tmp_path.iterdir())
    os.utime(path, ns=(1, 1))
    after = changed(**options)
    assert after != before
    path.write_bytes(path.read_bytes() + b" ")
    os.utime(path, ns=(1, 1))
    assert changed(**options) != after  # as by a copy that keeps the time


DEFAULTS = {"profile": "auto", "background": "files", "first": 0}


def test_a_folder_that_is_not_named_is_not_the_servers_own(nodes, demo, monkeypatch):
    """ComfyUI's working directory is of no user's choice; a home directory is."""
    monkeypatch.chdir(demo / "frames")
    with pytest.raises(InputError, match="folder: empty; expected a folder of EXR files"):
        call(nodes, "StssLoadFrames", folder=' ""\n', count=4, **DEFAULTS)
    monkeypatch.setenv("HOME", str(demo))
    assert len(call(nodes, "StssLoadFrames", folder="~/frames", count=4, **DEFAULTS)[1].frames) == 4


@pytest.mark.parametrize(
    ("rendered", "first", "taken"),
    [
        ({0, 2, 3}, 0, (True, False, True, True, False)),
        (None, 1, (True, False, True)),
        (None, 0, (True, False, True, False, True)),
    ],
)
def test_the_rendered_frames_are_those_of_a_run(nodes, write_frames, rendered, first, taken):
    """Every frame with a colour; where all have one, every second of the shot, wherever the node begins."""
    folder = write_frames(range(5), rendered=rendered)
    images, gbuffer = call(nodes, "StssLoadFrames", folder=str(folder), count=9, **DEFAULTS | {"first": first})
    assert gbuffer.rendered == taken
    assert len(images.numpy()) == sum(taken)


def test_a_frame_that_nothing_can_be_made_of_is_named(nodes, write_frames):
    """Left out without a word, as it was, all frames behind it would be shown too early."""
    folder = write_frames(range(8), rendered={0, 2, 6})
    message = "in: frame 4: no rendered frame just before it to extrapolate from; a count of 4 ends before it"
    with pytest.raises(InputError, match=message):
        call(nodes, "StssLoadFrames", folder=str(folder), count=8, **DEFAULTS)
    assert len(call(nodes, "StssLoadFrames", folder=str(folder), count=4, **DEFAULTS)[1].frames) == 4


def test_the_frames_choose_the_weights(nodes, write_frames, monkeypatch):
    """As in a run. Frames of a path tracer lose 2 dB by those for games."""

    def mean_normals(number, channels):
        return channels | {"normal.Z": 0.9 * channels["normal.Z"]}

    taken, supersampler = [], stss.Supersampler
    monkeypatch.setattr(
        stss, "Supersampler", lambda weights, **options: taken.append(weights) or supersampler("bilinear", **options)
    )
    for folder, change in (("games", None), ("films", mean_normals)):
        path = write_frames(range(2), rendered={0}, folder=folder, change=change)
        images, gbuffer = call(nodes, "StssLoadFrames", folder=str(path), count=2, **DEFAULTS)
        for weights in ("auto", "bilinear"):
            call(nodes, "StssSupersample", images=images, gbuffer=gbuffer, weights=weights, backend="ref")
    assert taken == ["realtime", "bilinear", "antialiased", "bilinear"]


def test_images_are_of_the_picture_without_overscan(nodes, tmp_path):
    """Other nodes know one size: that which a run's PNG have."""
    data, display = PixelWindow(-2, -1, 24, 16), PixelWindow(0, 0, 20, 14)
    for number in range(2):
        channels = frame_channels(number, (16, 24), color=number == 0)
        write_windows(tmp_path / "wide" / f"a.{number:04d}.exr", [(channels, data)], display)
    images, gbuffer = call(nodes, "StssLoadFrames", folder=str(tmp_path / "wide"), count=2, **DEFAULTS)
    assert tuple(images.shape) == (1, 14, 20, 3)
    channels = frame_channels(0, (16, 24))
    color = np.stack([channels[name] for name in "RGB"], axis=-1).astype(np.float32)
    np.testing.assert_array_equal(images.numpy()[0], transfer("srgb").encode(color)[1:15, 2:22])
    frames, _ = call(nodes, "StssSupersample", images=images, gbuffer=gbuffer, weights="bilinear", backend="ref")
    assert tuple(frames.shape) == (2, 28, 40, 3)


def test_the_workflow_fits_the_nodes(nodes):
    """ComfyUI keeps the values of a workflow by their order, and checks its keys: ``flags`` and ``properties`` must be there."""
    (path,) = (PACK.parent / "example_workflows").iterdir()
    workflow = json.loads(path.read_text())
    by_id = {node["id"]: node for node in workflow["nodes"]}
    ours = [node for node in workflow["nodes"] if node["type"] in nodes.NODE_CLASS_MAPPINGS]
    assert len(ours) == 2
    for node in ours:
        kind = nodes.NODE_CLASS_MAPPINGS[node["type"]]
        inputs = all_inputs(kind)
        widgets = {
            name: value for name, value in inputs.items() if not str(value[0]).isupper() or value[0] in {"STRING", "INT", "FLOAT"}
        }
        linked = {name: value[0] for name, value in inputs.items() if name not in widgets}
        assert {slot["name"]: slot["type"] for slot in node.get("inputs", ())} == linked
        assert [(slot["name"], slot["type"]) for slot in node["outputs"]] == list(
            zip(kind.RETURN_NAMES, kind.RETURN_TYPES, strict=True)
        )
        assert len(kind.OUTPUT_TOOLTIPS) == len(kind.RETURN_TYPES)
        for value, (choices, *more) in zip(node["widgets_values"], widgets.values(), strict=True):
            default = choices[0] if isinstance(choices, list) else more[0]["default"]
            assert value == default
    for node in workflow["nodes"]:
        assert {"flags", "properties"} <= node.keys()
    for link, source, output, target, slot, kind in workflow["links"]:
        assert by_id[source]["outputs"][output]["links"] == [link]
        assert by_id[target]["inputs"][slot]["link"] == link
        assert by_id[source]["outputs"][output]["type"] == by_id[target]["inputs"][slot]["type"] == kind
