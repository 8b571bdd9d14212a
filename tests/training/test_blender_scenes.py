# SPDX-License-Identifier: MIT
"""The renderer's scenes, as far as they go without Blender."""

import ast
import json
import math
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "training" / "blender"
MODULES = ("bitmaps", "looks", "make_set", "paths", "scenes", "shapes")


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


@pytest.mark.parametrize(("seed", "split", "frames"), [(1, "tests", 8), (1, "train", 0)])
def test_nonsense_is_refused(blender, seed, split, frames):
    with pytest.raises(ValueError, match=r"split|frames"):
        blender["scenes"].describe(seed, split, frames)


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


def test_the_light_of_a_clean_scene_needs_one_sample(many):
    clean = [scene for scene in many if scene["clean"]]
    assert len(clean) >= 20
    for scene in clean:
        assert [(light["kind"], light["soft"]) for light in scene["lights"]] == [("sun", 0.0)]
        assert not scene["sky"]["lights"]
        assert not any(look["gloss"] or look["metallic"][1] or look["glow"] or look["bump"] for look in scene["materials"])


def test_patterns_of_a_woven_scene_are_near_the_pixels_size(blender, many):
    """Seen from where the first camera stands, a cell in the middle is 0.7 to 6 pixels wide, and there are many such surfaces."""
    scenes, looks = blender["scenes"], blender["looks"]
    woven = [scene for scene in many if scene["woven"]]
    assert all(scene["clean"] for scene in woven)
    assert len(woven) >= 15
    fine = 0
    for scene in woven:
        away = math.dist(scene["shots"][0]["eye"], (0, 0, 0.4 if scene["layout"] == "table" else 1.2))
        focal = 0.5 * scenes.WIDTH / math.tan(0.5 * scene["fov"])
        painted = (look for look in scene["materials"] if look["texture"] in looks.CELL)
        cells = [looks.CELL[look["texture"]] / look["scale"] * focal / away for look in painted]
        fine += sum(looks.CELLS[0] * 0.999 <= cell <= looks.CELLS[1] * 1.001 for cell in cells)
    assert fine >= 8 * len(woven)


def test_a_level_scene_is_seen_straight_ahead_before_a_wall(blender, many):
    """At most 0.2 radians up or down; the wall is behind the middle, and there is lettering, and wires lie across the view."""
    level = [scene for scene in many if scene["level"]]
    assert 5 <= len(level) < sum(scene["woven"] for scene in many)
    steep = [s for scene in many if not scene["level"] for s in scene["shots"] if _pitch(s) > 0.2]
    assert len(steep) >= 20
    askew = []
    for scene in level:
        assert max(_pitch(shot) for shot in scene["shots"]) < 0.2
        eye, centre = scene["shots"][0]["eye"], (0.0, 0.0, 1.2)
        towards = math.atan2(eye[1] - centre[1], eye[0] - centre[0])
        (wall,) = [thing for thing in scene["objects"] if thing["shape"] == "cube" and thing["size"][0] > 40]
        assert wall["at"][0] * math.cos(towards) + wall["at"][1] * math.sin(towards) < -1
        across = [thing["turn"][2] - math.pi / 2 - towards for thing in scene["objects"] if thing["shape"] == "wires"]
        askew.append(min(abs(math.sin(angle)) for angle in across))
    assert sum(angle < 0.3 for angle in askew) >= 0.6 * len(level)
    lettering = [sum(thing["shape"] == "letters" for thing in scene["objects"]) for scene in level]
    assert sum(lettering) >= 2 * len(level)


def _pitch(shot):
    """How far the camera looks up or down, radians."""
    x, y, z = (b - a for a, b in zip(shot["eye"], shot["target"], strict=True))
    return abs(math.atan2(z, math.hypot(x, y)))


def test_another_path_is_another_way_through_the_same_scene(blender):
    first, second, third = (blender["scenes"].describe(6, "train", 8, path) for path in (0, 1, 2))
    different = [name for name in first if first[name] != second[name]]
    assert set(different) <= {"path", "shots", "camera", "cuts"}
    assert first["shots"] != second["shots"] != third["shots"]


def test_a_set_may_be_of_one_kind(blender):
    make_set, describe = blender["make_set"], blender["scenes"].describe
    planned = make_set.plan(16, "woven", 4)
    assert all(describe(seed, split, 4)["woven"] for split, seed in planned)
    assert make_set.plan(24, "woven", 4)[:16] == planned


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


def test_something_still_is_where_it_was_put(blender):
    assert blender["paths"].pose(None, 5) == ((0, 0, 0), (0, 0, 0))
    slide = {"kind": "slide", "rate": 0.5, "phase": 0, "along": [1, 0, 0], "middle": 4}
    assert blender["paths"].pose(slide, 6) == ((1, 0, 0), (0, 0, 0))


@pytest.mark.parametrize("kind", ["text", "windows", "leaves", "mesh", "stripes"])
def test_pictures(blender, kind):
    draw = blender["bitmaps"].picture
    picture = draw(kind, 7)
    assert picture.shape == (256, 256, 4)
    assert picture.dtype == np.float32
    assert 0 <= picture.min() < picture.max() <= 1
    assert np.array_equal(picture, draw(kind, 7))
    cut_out = (picture[..., 3] < 0.5).mean()
    assert 0.1 < cut_out < 0.95 if kind in blender["looks"].CUTOUTS else cut_out == 0


@pytest.mark.parametrize("kind", ["fence", "lattice", "wheel", "cables", "ladder", "card", "bush"])
def test_meshes_are_whole(blender, kind):
    mesh = blender["shapes"].mesh(kind, 1)
    assert len(mesh.uv) == sum(len(face) for face in mesh.faces)
    assert {corner for face in mesh.faces for corner in face} == set(range(len(mesh.corners)))
    assert np.abs(mesh.corners).max() < 0.7


def test_a_set_is_split_by_scene_from_its_beginning(blender):
    planned = blender["make_set"].plan(64)
    assert len(set(planned)) == 64
    assert Counter(split for split, _ in planned) == {"train": 48, "validation": 8, "test": 8}
    assert {split for split, _ in planned[:8]} == set(blender["scenes"].SPLITS)
    assert blender["make_set"].plan(96)[:64] == planned, "a larger set adds to a smaller one"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.name)
def test_sizes_and_licence(path):
    text = path.read_text()
    assert text.startswith("# SPDX-License-Identifier: MIT\n")
    assert len(text.splitlines()) <= 300
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            body = node.body[1:] if ast.get_docstring(node) else node.body
            assert sum(statement.end_lineno - statement.lineno + 1 for statement in body) <= 40, node.name
