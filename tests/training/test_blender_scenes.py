# SPDX-License-Identifier: MIT
"""The renderer's scenes, as far as they go without Blender."""

import json
import math
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "training" / "blender"
MODULES = ("bitmaps", "looks", "paths", "scenes", "shapes")


@pytest.fixture(scope="module")
def blender():
    """The modules that need no bpy: they lie in a folder of scripts, not in a package."""
    kept = {name: sys.modules.pop(name, None) for name in MODULES}
    sys.path.insert(0, str(FOLDER))
    try:
        yield {name: __import__(name) for name in MODULES}
    finally:
        sys.path.remove(str(FOLDER))
        for name, module in kept.items():
            sys.modules.pop(name, None)
            if module is not None:
                sys.modules[name] = module


@pytest.fixture(scope="module")
def many(blender):
    return [blender["scenes"].describe(seed, "train", 12) for seed in range(60)]


def test_the_same_seed_gives_the_same_scene_and_it_is_plain_data(blender):
    a, b = (blender["scenes"].describe(3, "train", 12) for _ in range(2))
    assert a == b
    assert json.loads(json.dumps(a, allow_nan=False))["objects"] == a["objects"]


def test_no_scene_of_one_split_is_in_another(blender):
    describe = blender["scenes"].describe
    seen = [json.dumps(describe(seed, split, 8)["objects"]) for split in blender["scenes"].SPLITS for seed in range(20)]
    assert len(set(seen)) == len(seen)


def test_a_set_holds_all_that_was_asked_for(blender, many):
    contents = Counter(word for scene in many for word in scene["contents"])
    wanted = ("checker", "noise", "text", "leaves", "mesh", "bush", "fence", "cables", "wheel", "lattice", "letters")
    assert min(contents[word] for word in wanted) >= 3
    moves = Counter(move for scene in many for move in scene["camera"])
    assert min(moves[move] for move in (*blender["scenes"].MOVES, "shake")) >= 4
    assert 5 <= sum(bool(scene["cuts"]) for scene in many) <= 30
    assert sum(any(light.get("rate") or light.get("motion") for light in scene["lights"]) for scene in many) >= 20
    metals = [any(look["metallic"][0] == 1 for look in scene["materials"]) for scene in many if not scene["clean"]]
    assert len(metals) >= 15
    assert sum(metals) >= 0.9 * len(metals)
    assert {scene["layout"] for scene in many} == set(blender["scenes"].LAYOUTS)


def test_what_moves_has_a_number_of_its_own(many):
    for scene in many:
        numbers = [thing["index"] for thing in scene["objects"] if thing["motion"] is not None]
        assert numbers == list(range(1, scene["moving"] + 1))
        assert all(thing["index"] == 0 for thing in scene["objects"] if thing["motion"] is None)


def test_the_camera_moves_smoothly_but_at_cuts_and_stays_above_the_floor(blender, many):
    camera, jumps = blender["paths"].camera, 0
    for scene in many:
        eyes = [camera(scene["shots"], t)[0] for t in range(-1, 13)]
        assert min(eye[2] for eye in eyes) >= blender["paths"].FLOOR
        assert np.isfinite(eyes).all()
        steps = {t: math.dist(a, b) for t, (a, b) in enumerate(pairwise(eyes))}
        cuts = [number - 1 for number in scene["cuts"]]
        assert max(step for t, step in steps.items() if t not in cuts) < 1.5
        jumps += sum(steps[t] > 1.5 for t in cuts)
    assert jumps >= 5


@pytest.mark.parametrize("kind", ["text", "leaves"])
def test_pictures(blender, kind):
    draw = blender["bitmaps"].picture
    picture = draw(kind, 7)
    assert picture.shape == (256, 256, 4)
    assert picture.dtype == np.float32
    assert 0 <= picture.min() < picture.max() <= 1
    assert np.array_equal(picture, draw(kind, 7))
    cut_out = (picture[..., 3] < 0.5).mean()
    assert 0.1 < cut_out < 0.95 if kind in blender["looks"].CUTOUTS else cut_out == 0


@pytest.mark.parametrize("kind", ["fence", "bush"])
def test_meshes_are_whole(blender, kind):
    mesh = blender["shapes"].mesh(kind, 1)
    assert len(mesh.uv) == sum(len(face) for face in mesh.faces)
    assert {corner for face in mesh.faces for corner in face} == set(range(len(mesh.corners)))
    assert np.abs(mesh.corners).max() < 0.7


def test_a_set_is_split_by_scene_from_its_beginning(blender):
    planned = blender["scenes"].plan(64)
    assert len(set(planned)) == 64
    assert Counter(split for split, _ in planned) == {"train": 48, "validation": 8, "test": 8}
    assert {split for split, _ in planned[:8]} == set(blender["scenes"].SPLITS)
    assert blender["scenes"].plan(96)[:64] == planned, "a larger set adds to a smaller one"
