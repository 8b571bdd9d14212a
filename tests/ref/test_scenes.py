# SPDX-License-Identifier: MIT
"""The analytic scenes: their buffers must be true of the scene, and not merely repeat the code that wrote them."""

import numpy as np
import pytest

from conformance.scenes import DEMO, SCENES, Camera, Object, Scene, look, render
from conformance.scenes.materials import Finish, Material, noise
from conformance.scenes.shapes import Box, Disc, Plane

SIZE = (36, 64)
GREY = Material(Finish((0.5, 0.5, 0.5)))
# Coordinates up to 64 px, each from some 20 float64 operations: 64 * 20 * 2**-53 < 2e-13.
PIXELS = 1e-9


def grid(size=SIZE):
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    return np.stack([x, y], axis=-1)


def still(x, y, z):
    return lambda frame: (x, y, z)


def columns(points):
    """(N, 3) as the scenes' own (3, N)."""
    return np.ascontiguousarray(points.T)


def forward_camera(position=(0, -100, 0)):
    """Looks along +y; right is +x, down is -z."""
    x, y, z = position
    return Camera(still(x, y, z), still(x, y + 1, z), spread=0.5)


@pytest.mark.parametrize("name", SCENES)
def test_position_projects_to_its_pixel(name):
    scene = SCENES[name]
    for frame in (0, 7, 8):
        out = render(scene, frame, *SIZE)
        hit = np.isfinite(out.depth)
        pixels = scene.camera.view(frame, SIZE).project(columns(out.position[hit]))
        assert np.max(np.abs(pixels - grid()[hit])) < PIXELS


def previous_places(scene, frame, out):
    """(H, W, 3) where each point was a frame earlier, from its position, its object's number and the object's paths."""
    places = out.position.copy()
    for number, item in zip(scene.numbers, scene.objects, strict=True):
        here = (out.stencil == number) & np.isfinite(out.depth)
        if number > 0 and here.any():
            local = item.transform(frame).to_object(columns(out.position[here]))
            places[here] = item.transform(frame - 1).to_world(local).T
    return places


@pytest.mark.parametrize("name", [name for name in SCENES if name != "cut"])
def test_motion_leads_to_the_same_point_of_the_surface_unless_something_hides_it(name):
    """A ray of the previous frame through p + motion meets the very point, or something in front of it."""
    scene, frame = SCENES[name], 9
    out = render(scene, frame, *SIZE)
    hit = np.isfinite(out.depth)
    expected = previous_places(scene, frame, out)[hit]
    at = (grid() + out.motion)[hit]
    before = look(scene, frame - 1, at[:, 0], at[:, 1], SIZE)
    away = np.linalg.norm(before.position - expected, axis=1)
    # On a silhouette a place rounded by e = 1e-12 cm meets the sphere sqrt(2 * radius * e) = 1e-5 cm away.
    same = away < 1e-4
    view = scene.camera.view(frame - 1, SIZE)
    depth = (expected - view.position[:, 0]) @ view.forward
    assert np.all(before.depth[~same] < depth[~same])
    assert np.mean(same) > 0.9


def test_a_point_behind_the_previous_camera_has_no_motion():
    """The camera turns about: what it sees now was behind it."""
    camera = Camera(still(0, 0, 100), lambda frame: (0, 1 if frame > 0 else -1, 100))
    out = render(Scene("turn", camera, (Object("floor", Plane(), GREY),)), 1, *SIZE)
    assert np.isnan(out.motion).all()


def test_what_stands_still_moves_by_exactly_nothing():
    """Exactly: the motion chain asks for 0 itself."""
    assert not render(SCENES["static"], 5, *SIZE).motion.any()
    out = render(SCENES["object"], 5, *SIZE)
    assert not out.motion[out.stencil == 0].any()
    assert out.motion[out.stencil > 0].any(axis=-1).all()


def test_motion_of_an_object_that_moves_sideways_is_as_computed_by_hand():
    """2 cm to the right and 1 cm up a frame, 100 cm away: 1/64 px a cm there, so 64 of them."""
    disc = Object("disc", Disc(10), GREY, path=lambda frame: ((2.0 * frame, 0.0, 1.0 * frame), 0.0))
    out = render(Scene("one", forward_camera(), (disc,)), 3, *SIZE)
    here = out.stencil == 1
    # width 64 px = 2 * spread * distance = 100 cm
    assert here.any()
    assert np.max(np.abs(out.motion[here] - (-2 * 0.64, 0.64))) < PIXELS
    assert np.max(np.abs(out.depth[here] - 100)) < PIXELS


def test_where_nothing_is_hit_everything_else_is_zero():
    out = render(DEMO, 4, *SIZE)
    sky = np.isinf(out.depth)
    for name in ("normal", "position", "stencil", "nov", "base_color", "roughness", "metallic"):
        assert not getattr(out, name)[sky].any(), name
        assert name in {"stencil", "metallic", "position"} or getattr(out, name)[~sky].any(), name


def test_truth_averaged_in_fours_is_the_small_frame_where_the_picture_is_smooth():
    """Shifted by one large pixel either way it is clearly less so: the two grids lie on each other."""
    cloth = Material(Finish((0.1, 0.2, 0.3)), Finish((0.9, 0.7, 0.5)), noise(60))
    scene = Scene("cloth", forward_camera(), (Object("cloth", Box((500, 1, 500)), cloth),))
    low = render(scene, 0, *SIZE).color
    truth = render(scene, 0, 2 * SIZE[0], 2 * SIZE[1], samples=16).color

    def error(dy, dx):
        moved = np.roll(truth, (dy, dx), (0, 1))
        fours = moved.reshape(SIZE[0], 2, SIZE[1], 2, 3).mean(axis=(1, 3))
        return np.mean(np.abs(fours - low)[1:-1, 1:-1])

    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        assert 5 * error(0, 0) < error(dy, dx)
