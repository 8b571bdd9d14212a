# SPDX-License-Identifier: MIT
"""The analytic scenes: what their buffers say must be true of the scene, not only of the code that wrote them."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from conformance.scenes import DEMO, SCENES, Camera, Object, Scene, look, render
from conformance.scenes.materials import Finish, Material, noise
from conformance.scenes.render import sample_offsets
from conformance.scenes.shapes import Box, Cylinder, Disc, Plane, Sphere

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
        found = scene.camera.view(frame, SIZE).project(columns(out.position[hit]))
        assert np.max(np.abs(found - grid()[hit])) < PIXELS


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


def test_sky_moves_as_something_very_far_away():
    out = render(DEMO, 4, *SIZE)
    sky = np.isinf(out.depth)
    now, before = (DEMO.camera.view(frame, SIZE) for frame in (4, 3))
    far = now.position + 1e12 * now.rays(*grid()[sky].T)
    # The camera moves by 3.4 cm: at 1e12 cm that is 3.4e-12 of the 55 px that a distance of 1 spans.
    assert sky.any()
    assert np.max(np.abs(before.project(far) - grid()[sky] - out.motion[sky])) < PIXELS


def test_where_nothing_is_hit_everything_else_is_zero():
    out = render(DEMO, 4, *SIZE)
    sky = np.isinf(out.depth)
    for name in ("normal", "position", "stencil", "nov", "base_color", "roughness", "metallic"):
        assert not getattr(out, name)[sky].any(), name
        assert name in {"stencil", "metallic", "position"} or getattr(out, name)[~sky].any(), name


@pytest.mark.parametrize("name", SCENES)
def test_ranges(name):
    out = render(SCENES[name], 8, *SIZE)
    hit = np.isfinite(out.depth)
    # A unit vector from a square root and a division, turned at most once: some 10 roundings of 2**-53.
    assert np.max(np.abs(np.linalg.norm(out.normal[hit], axis=-1) - 1)) < 1e-14
    assert np.all((out.nov[hit] >= 0) & (out.nov[hit] <= 1 + 1e-14))
    assert np.all(out.depth[hit] > 0)
    for values in (out.base_color, out.roughness, out.metallic):
        assert np.all((values >= 0) & (values <= 1))
    assert np.all((out.color >= 0) & (out.color < 4))
    assert np.mean(out.color > 1.5) < 0.01


def test_stencil_numbers_the_moving_objects():
    moving = [item.name for item in SCENES["object"].objects if item.path]
    assert set(np.unique(render(SCENES["object"], 8, 90, 160).stencil)) == {0, *range(1, len(moving) + 1)}
    assert not render(SCENES["static"], 8, *SIZE).stencil.any()


def test_textures_move_with_the_object():
    """p has the base colour that p + motion had a frame earlier, also where the object turns."""
    out = render(DEMO, 9, 90, 160)
    crate = out.stencil == 3
    at = (grid((90, 160)) + out.motion)[crate]
    before = look(DEMO, 8, at[:, 0], at[:, 1], (90, 160))
    visible = before.stencil == 3
    assert visible.sum() > 100
    same = (before.base_color == out.base_color[crate]).all(axis=1)
    # Where the point lies on a line of the checker to within rounding it may fall on either side: none here.
    assert same[visible].all()


def test_a_frame_of_twice_the_size_has_four_pixels_in_each():
    """Rays through a corner that four large pixels share are those through the centre of the small one."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].reshape(2, -1).astype(np.float64)
    low = DEMO.camera.view(3, SIZE).rays(x, y)
    high = DEMO.camera.view(3, (2 * SIZE[0], 2 * SIZE[1])).rays(2 * x + 0.5, 2 * y + 0.5)
    assert np.max(np.abs(low - high)) < 1e-14  # components of at most 1, some 10 roundings of 2**-53


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


@pytest.mark.parametrize("samples", [1, 4, 9, 16])
def test_samples_are_spread_evenly_and_balanced(samples):
    side = math.isqrt(samples)
    x, y = sample_offsets(samples)
    cells = np.floor((x + 0.5) * side) * side + np.floor((y + 0.5) * side)
    assert len(np.unique(cells)) == samples
    assert len(np.unique(np.round(x * samples, 6))) == len(np.unique(np.round(y * samples, 6))) == samples
    assert abs(x.mean()) < 1e-15  # sums of at most 16 numbers below 1/2
    assert abs(y.mean()) < 1e-15


def test_samples_must_be_square():
    with pytest.raises(ValueError, match="square number, got 8"):
        render(DEMO, 0, 8, 8, samples=8)


def test_same_arguments_same_bits():
    first, second = (render(DEMO, 6, *SIZE, samples=4) for _ in range(2))
    for field in fields(first):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name), err_msg=field.name)


def test_more_samples_change_the_colour_only():
    one, four = render(DEMO, 6, *SIZE), render(DEMO, 6, *SIZE, samples=4)
    for field in fields(one):
        same = np.array_equal(getattr(one, field.name), getattr(four, field.name))
        assert same == (field.name != "color"), field.name


def test_demo_is_a_fair_sequence():
    """All motion is finite; there is sky, a mirror, and each moving object; things move by pixels, not by fractions."""
    frames = [render(DEMO, number, *SIZE) for number in range(16)]
    assert all(np.isfinite(frame.motion).all() for frame in frames)
    assert all(np.isinf(frame.depth).any() for frame in frames)
    assert all(frame.metallic.max() == 1 for frame in frames)
    assert all(set(np.unique(frame.stencil)) == {0, 1, 2, 3} for frame in frames)
    # At 160 px the motion is two and a half times that at 64.
    assert all(0.5 < np.abs(frame.motion).max() < 2 for frame in frames)


def test_shadow_falls_where_the_sun_is_hidden():
    floor, ball = Object("floor", Plane(), GREY), Object("ball", Sphere(20), GREY, at=(0, 0, 60))
    scene = Scene("shadow", Camera(still(0, -300, 200), still(0, 0, 0)), (floor, ball))
    scene = replace(scene, light=replace(scene.light, toward=(0, 0, 1)))
    view = scene.camera.view(0, SIZE)
    under, beside = view.project(np.array([[0.0, 40.0], [0.0, 0.0], [0.0, 0.0]]))
    out = look(scene, 0, *np.stack([under, beside]).T, SIZE)
    assert np.max(np.abs(out.position - [(0, 0, 0), (40, 0, 0)])) < 1e-9  # 400 cm * 20 roundings of 2**-53
    assert np.all(out.color[0] < 0.6 * out.color[1])


@pytest.mark.parametrize(
    ("shape", "origin", "direction", "distance", "normal"),
    [
        (Plane(), (1, 2, 5), (0, 0, -1), 5, (0, 0, 1)),
        (Plane(), (1, 2, 5), (0, 0, 1), np.inf, None),
        (Plane(), (1, 2, 5), (1, 0, 0), np.inf, None),
        (Plane(3, 1), (2.5, 0.5, -4), (0, 0, 1), 4, (0, 0, 1)),
        (Plane(3, 1), (2.5, 1.5, -4), (0, 0, 1), np.inf, None),
        (Disc(2), (1, -3, 1), (0, 1, 0), 3, (0, 1, 0)),
        (Disc(2), (1.5, -3, 1.5), (0, 1, 0), np.inf, None),
        (Disc(2, flat=True), (1, 1, 7), (0, 0, -1), 7, (0, 0, 1)),
        (Sphere(2), (0, -5, 0), (0, 1, 0), 3, (0, -1, 0)),
        (Sphere(2), (0, -5, 3), (0, 1, 0), np.inf, None),
        (Sphere(2), (0, 5, 0), (0, 1, 0), np.inf, None),
        (Sphere(2), (0, 0, 0), (1, 0, 0), 2, (1, 0, 0)),
        (Sphere(5), (0, -10, 3), (0, 1, 0), 6, (0, -0.8, 0.6)),
        (Box((1, 2, 3)), (5, 1, 1), (-1, 0, 0), 4, (1, 0, 0)),
        (Box((1, 2, 3)), (0.5, 1, -9), (0, 0, 1), 6, (0, 0, -1)),
        (Box((1, 2, 3)), (0, 0, 0), (0, 1, 0), 2, (0, 1, 0)),
        (Box((1, 2, 3)), (5, 2.5, 1), (-1, 0, 0), np.inf, None),
        (Box((1, 2, 3)), (-3, -4, 0), (0.6, 0.8, 0), 10 / 3, (-1, 0, 0)),
        (Cylinder(3, 10), (0, -9, 4), (0, 1, 0), 6, (0, -1, 0)),
        (Cylinder(3, 10), (1, 1, 15), (0, 0, -1), 5, (0, 0, 1)),
        (Cylinder(3, 10), (2.5, 2.5, 15), (0, 0, -1), np.inf, None),
        (Cylinder(3, 10), (0, -9, 11), (0, 1, 0), np.inf, None),
        (Cylinder(3), (0, -9, 1e4), (0, 1, 0), 6, (0, -1, 0)),
        (Cylinder(3), (0, 0, 0), (1, 0, 0), 3, (1, 0, 0)),
    ],
)
def test_shapes_by_hand(shape, origin, direction, distance, normal):
    start, along = (np.array(v, np.float64)[:, None] for v in (origin, direction))
    found = shape.distance(start, along)
    if normal is None:
        assert np.isinf(found)
        return
    assert abs(found[0] - distance) < 1e-12  # numbers up to 100, some 20 roundings of 2**-53
    assert np.max(np.abs(shape.normal(start + found * along)[:, 0] - normal)) < 1e-14
    assert np.linalg.norm(start + found * along) <= shape.reach + 1e-9
