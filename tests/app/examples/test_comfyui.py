"""The nodes for ComfyUI, called as it calls them: by class, with keywords, tensors in and tensors out."""

import importlib.util
import os
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import stss
from stss.images.color import transfer
from stss_ground.errors import InputError

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


def call(nodes, name, **inputs):
    """The outputs of a node; its inputs must be those that it declares, its outputs as many as it names."""
    node = nodes.NODE_CLASS_MAPPINGS[name]
    kinds = node.INPUT_TYPES()["required"]
    assert kinds.keys() == inputs.keys()
    for key, (kind, *_) in kinds.items():
        assert not isinstance(kind, list) or inputs[key] in kind
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
    assert steps == [1, 1]
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
    assert changed(**options) != before
