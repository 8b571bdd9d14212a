"""Hand-computed cases of the image-space stages, beside the judge's properties, which the reference must have, and SciPy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conformance.cases.planes import SEEDS
from conformance.judging.judge import Judge, Tier
from conformance.suite.run_suite import run_suite
from stss.port import ReferencePort
from stss_ref.accumulate import accumulate, slowness
from stss_ref.arrays import ArrayError
from stss_ref.constants import HoleLimits
from stss_ref.depth import normalise_depth
from stss_ref.holes import cosine, holes, squared_footprint
from stss_ref.motion_chain import motion_chain
from stss_ref.occlusion_warp import occlusion_warp, splat
from stss_ref.reshade import (
    COSINE,
    REACH,
    STEPS,
    brightness,
    four_samples,
    is_mixed,
    like_sums,
    likeness,
    reshade,
    shows_surface,
    square_rows,
)
from stss_ref.rrm import draw_rectangle, rrm
from stss_ref.sample import follow, leads_inside, taps
from stss_ref.warp import warp


def constant(size, *values):
    return np.broadcast_to(np.array(values, np.float64), (*size, len(values))).copy()


class TestWarp:
    def test_errors_name_the_array(self):
        with pytest.raises(ArrayError, match=r"motion: expected shape \(2, 3, 2\), got \(2, 3, 3\)"):
            warp(np.zeros((2, 3, 1)), np.zeros((2, 3, 3)))
        color = np.zeros((2, 3, 1))
        color[0, 2] = np.nan
        with pytest.raises(ArrayError, match=r"color: 1 non-finite values, first at index \(0, 2, 0\)"):
            warp(color, np.zeros((2, 3, 2)))


class TestFollow:
    """Where a motion leads is a whole pixel and a fraction, never a rounded sum (decision 13)."""

    def test_far_from_the_corner_the_fraction_is_the_motions(self):
        """Between 0 at column 4000 and 1 at 4001 lies the fraction itself: 0.1f, where 4000 + 0.1f is 4000.10009765625."""
        color, motion = np.zeros((1, 4003, 1), np.float32), np.zeros((1, 4003, 2), np.float32)
        color[0, 4001] = 1
        motion[0, 4000, 0] = 0.1
        motion[0, 4002, 0] = -1.9  # floor -2, and (2 - 1.9f) is exact
        warped, _ = warp(color, motion)
        assert warped.dtype == np.float32
        assert warped[0, 4000, 0] == np.float32(0.1)
        assert warped[0, 4002, 0] == np.float32(2) - np.float32(1.9)

    def test_just_left_of_a_pixel_is_the_one_before_it(self):
        """20 - 2^-40 is 20 in float32; its whole pixel is 19, and its fraction rounds to 1."""
        motion = np.zeros((1, 40, 2), np.float32)
        motion[0, 20, 0] = -(2.0**-40)
        at = follow(motion)
        assert (at.x[0, 20], at.fx[0, 20], at.x[0, 21], at.fx[0, 21]) == (19, 1, 21, 0)
        color = np.arange(40, dtype=np.float32).reshape(1, 40, 1)
        assert warp(color, motion)[0][0, 20, 0] == 20
        depth = np.full((1, 40), 0.5, np.float32)
        depth[0, 20] = 0.25
        assert splat(motion, depth)[0, [19, 20, 21], 0].tolist() == [np.float32(-(2.0**-40)), np.float32(-(2.0**-40)), 0]

    def test_the_border_by_whole_pixel_and_fraction(self):
        """0 and W - 1 are inside; a hair to the left or to the right of them is not."""
        hair = np.float32(2.0**-60)
        motion = np.zeros((1, 4, 2), np.float32)
        motion[0, :, 0] = -hair, np.nextafter(np.float32(-1), np.float32(-2)), 1, hair
        np.testing.assert_array_equal(leads_inside(follow(motion)), [[False, False, True, False]])
        at = taps(follow(motion))
        np.testing.assert_array_equal((at.x0[0], at.fx[0]), [[0, 0, 3, 3], [0, 0, 0, 0]])
        at = taps(follow(motion[..., ::-1].transpose(1, 0, 2)))  # the same along y
        np.testing.assert_array_equal((at.y0[:, 0], at.fy[:, 0]), [[0, 0, 3, 3], [0, 0, 0, 0]])

    @pytest.mark.parametrize("far", [3e9, 1e300])
    def test_however_far_it_is_beyond_the_frame(self, far):
        """No integer holds where it leads; the nearest border pixel is read, and nothing written or chained."""
        color, motion = np.arange(6.0).reshape(2, 3, 1), np.zeros((2, 3, 2))
        motion[0, 1], motion[1, 1] = (far, -far), (-far, far)
        warped, inside = warp(color, motion)
        assert (warped[0, 1, 0], warped[1, 1, 0]) == (2, 3)
        assert not inside[:, 1].any()
        assert motion_chain(np.stack([motion, constant((2, 3), 1, 1)]))[:, 1].tolist() == motion[:, 1].tolist()
        assert np.abs(splat(motion, np.zeros((2, 3)))).max() == 0

    @pytest.mark.parametrize(("left", "reads"), [(-0.5, 5), (-1e-30, 5), (-1, 0), (-1.5, 0), (-2, 0)])
    def test_trunc_left_of_the_frame(self, left, reads):
        first, earlier = np.zeros((2, 3, 2), np.float32), np.full((2, 3, 2), 5, np.float32)
        first[0, 0, 0] = left
        assert motion_chain(np.stack([first, earlier]))[0, 0, 1] == reads


class TestMotionChain:
    def test_steady_motion_adds_up(self):
        """A whole pixel a frame over three frames is three pixels, as long as the chain stays inside."""
        chained = motion_chain(np.stack([constant((4, 9), -1, 0)] * 3))
        np.testing.assert_array_equal(chained[:3, 4:], constant((3, 5), -3, 0))
        # Pixel 1 lands on 0 and takes one more step there, then leaves the frame and stops; pixel 0 stops at once:
        # trunc(-1) is outside, and outside reads 0.
        np.testing.assert_array_equal(chained[0, :4, 0], [-1, -2, -3, -3])
        # In the last row two of the four pixels lie outside: 0, so the chain stops.
        np.testing.assert_array_equal(chained[3, 4:], constant((5,), -1, 0))

    def test_the_longest_of_four_wins(self):
        earlier = np.array([[[1.0, 0], [0, -3]], [[2, 2], [-1, 1]]])
        first = np.zeros((2, 2, 2))
        first[0, 0] = 0.25
        assert motion_chain(np.stack([first, earlier]))[0, 0].tolist() == [0.25, -2.75]

    def test_each_component_counts_for_the_length(self):
        for longest in ([4.0, 0], [0, 4.0]):
            earlier = np.array([[[1.0, 1], [2, -2]], [[-3, 3 / 4], longest]])
            assert motion_chain(np.stack([np.zeros((2, 2, 2)), earlier]))[0, 0].tolist() == longest

    def test_beyond_the_right_and_the_lower_border_all_is_still(self):
        chained = motion_chain(np.stack([np.zeros((2, 3, 2)), constant((2, 3), 1, 2)]))
        assert chained[..., 1].tolist() == [[2, 2, 0], [0, 0, 0]]

    def test_between_the_pixels_0_and_1_left_of_the_frame(self):
        """Truncated, a place between -1 and 0 is 0: columns 0 and 1 are read."""
        earlier = np.stack([[[1.0, 0], [2, 0], [3, 0]]] * 2)
        first = np.zeros((2, 3, 2))
        first[0, 0, 0] = -0.5
        assert motion_chain(np.stack([first, earlier]))[0, 0].tolist() == [1.5, 0]

    def test_a_still_pixel_stops_the_chain(self):
        earlier = np.array([[[1.0, 0], [0, -3]], [[0, 0], [-1, 1]]])
        first = np.full((2, 2, 2), 0.25)
        assert motion_chain(np.stack([first, earlier]))[0, 0].tolist() == [0.25, 0.25]

    def test_the_first_of_equally_long_ones_stays(self):
        earlier = np.array([[[3.0, 4], [5, 0]], [[0, 5], [-4, 3]]])
        assert motion_chain(np.stack([np.zeros((2, 2, 2)), earlier]))[0, 0].tolist() == [3, 4]

    def test_non_finite_motion_stays_non_finite(self):
        earlier = constant((3, 3), 1, 1)
        earlier[1, 1, 0] = np.nan
        first = np.zeros((3, 3, 2))
        first[2, 2, 0] = np.inf
        chained = motion_chain(np.stack([first, earlier]))
        finite = np.isfinite(chained).all(axis=-1)
        # Whoever has the bad pixel among its four; and the one that was bad to begin with.
        assert finite.tolist() == [[False, False, True], [False, False, True], [True, True, False]]

    def test_of_motions_that_are_not_finite_the_first_wins(self):
        """Each counts as infinitely long, whichever component it is; and the finite component of a chain stays as it is."""
        earlier = constant((2, 2), 1, 1)
        earlier[0] = (np.inf, 0), (np.nan, 1)
        assert motion_chain(np.stack([np.zeros((2, 2, 2)), earlier]))[0, 0].tolist() == [np.inf, 0]
        assert motion_chain(np.stack([constant((2, 2), np.inf, 3), constant((2, 2), 1, 1)]))[0, 0].tolist() == [np.inf, 3]

    @pytest.mark.parametrize(("fraction", "read"), [((0.49, 0.5), 3), ((0.5, 0.49), 2), ((0.55, 0.55), 4), ((0.25, 0.25), 1)])
    def test_the_nearest_of_four(self, fraction, read):
        """Half a pixel is the next one."""
        earlier = np.array([[[1.0, 0], [2, 0]], [[3, 0], [4, 0]]])
        assert motion_chain(np.stack([constant((2, 2), *fraction), earlier]), "nearest")[0, 0, 0] == read + fraction[0]

    def test_between_four(self):
        earlier = np.array([[[1.0, 0], [2, 0]], [[4, 0], [8, 0]]])
        assert motion_chain(np.stack([constant((2, 2), 0.5, 0.25), earlier]), "bilinear")[0, 0, 0] == 0.5 + 1.5 + (6 - 1.5) / 4


def hole_inputs(size=(4, 4), **changed):
    inputs = {
        "motion": constant(size, 0, 0),
        "stencil_previous": np.zeros(size),
        "stencil": np.zeros(size),
        "normal_previous": constant(size, 0, 0, 1),
        "normal": constant(size, 0, 0, 1),
        "position_previous": constant(size, 0, 0, 0),
        "position": constant(size, 0, 0, 0),
        "nov": np.ones(size),
        "depth": np.zeros(size),
    }
    return {name: np.asarray(changed.get(name, array), array.dtype) for name, array in inputs.items()}


def slope(size=(4, 4), step=(3.0, 4.0), lift=0.0):
    """Positions whose neighbours are ``step`` apart, across and down."""
    y, x = np.indices(size)
    return np.stack([step[0] * x, step[1] * y, 0 * x + lift], axis=-1)


class TestHoles:
    @pytest.mark.parametrize(("moved", "valid"), [(0.3, True), (0.375, False), (0.4, False)])
    def test_a_third_of_another_object_is_a_hole(self, moved, valid):
        """The earlier stencil is read between the pixels: between 0 and 1 it is the way to the other object."""
        inputs = hole_inputs((2, 4), motion=constant((2, 4), moved, 0), stencil_previous=np.tile([0, 0, 1, 1], (2, 1)))
        assert holes(**inputs)[0, 1] == valid

    def test_an_unmoved_scene_has_none(self):
        assert holes(**hole_inputs()).all()

    @pytest.mark.parametrize(
        ("nov", "depth", "bias"),
        [(1, 0, 7.5), (-1, 0, 7.5), (0, 0, 45), (0.5, 0, 26.25), (1, 0.5, 32.5), (0, 1, 95)],
    )
    def test_the_bias_of_a_static_surface(self, nov, depth, bias):
        """A distance of exactly the bias is no hole yet; the next number is."""
        for distance, valid in ((bias, True), (np.nextafter(bias, np.inf), False)):
            position = constant((4, 4), distance, 0, 0)
            inputs = hole_inputs(position=position, nov=np.full((4, 4), nov), depth=np.full((4, 4), depth))
            assert (holes(**inputs, test="paper") == valid).all()

    def test_the_footprint_limits_a_static_surface(self):
        """Footprints of 5: an offset of exactly 7.5 is no hole yet; the next number is. NoV and depth do not count."""
        for distance, valid in ((7.5, True), (np.nextafter(7.5, np.inf), False)):
            there = slope(lift=distance)
            inputs = hole_inputs(position=slope(), position_previous=there, nov=np.zeros((4, 4)), depth=np.ones((4, 4)))
            assert (holes(**inputs) == valid).all()

    def test_the_footprint_is_to_the_nearer_neighbour_that_counts(self):
        position = slope()
        position[1, 2] += (100, 0, 0)  # beyond a silhouette
        position[3, 3] = np.nan
        squared = squared_footprint(position)
        assert squared[1, 1] == squared[3, 2] == squared[2, 3] == 25
        assert squared[1, 2] == 97**2 + 100**2 + 16
        assert squared_footprint(position[:1, :1]) == squared_footprint(position[3:, 3:]) == 0

    def test_of_the_paper_s_four_taps_the_farthest_counts_even_with_no_weight(self):
        previous = slope()
        previous[2, 2] += (100, 0, 0)
        valid = holes(**hole_inputs(position=slope(), position_previous=previous), test="paper")
        assert not valid[1:3, 1:3].any()
        assert valid.sum() == 12
        assert (~holes(**hole_inputs(position=slope(), position_previous=previous))).sum() == 1

    def test_moving_objects_are_judged_by_their_normals(self):
        angle = np.arccos(0.97)
        one = np.ones((4, 4))
        turned = constant((4, 4), np.sin(angle), 0, np.cos(angle))
        moving = {"stencil": one, "stencil_previous": one, "position": constant((4, 4), 1e6, 0, 0)}
        assert holes(**hole_inputs(**moving)).all()  # far away, but it moves
        assert not holes(**hole_inputs(**moving, normal=turned)).any()
        assert holes(**hole_inputs(**moving, normal=constant((4, 4), 0, 0, 0), normal_previous=constant((4, 4), 0, 0, 0))).all()
        assert not holes(**hole_inputs(**moving, normal=constant((4, 4), 0, 0, 0))).any()

    def test_a_short_normal_counts_less(self):
        """1e-5 is added to its length; a cosine of exactly the limit is no hole yet."""
        up, short = constant((1, 1), 0, 0, 1), constant((1, 1), 0, 0, 1e-5)
        assert np.abs(cosine(up, short) - 0.5) < 2**-50
        one = np.ones((1, 1))
        planes = hole_inputs((1, 1), normal=up, normal_previous=short, stencil=one, stencil_previous=one)
        limit = cosine(up, short).item()
        assert holes(**planes, limits=HoleLimits(cosine=limit)).all()
        assert not holes(**planes, limits=HoleLimits(cosine=np.nextafter(limit, 1))).any()

    def test_another_object_is_a_hole(self):
        inputs = hole_inputs(stencil=np.full((4, 4), 2.0), stencil_previous=np.full((4, 4), 1.0))
        assert not holes(**inputs).any()
        inputs = hole_inputs(stencil=np.full((4, 4), 1 / 3), stencil_previous=np.zeros((4, 4)))
        assert holes(**inputs).all()  # 3 |s - s'| = 1 is not > 1

    def test_the_limits_are_parameters(self):
        inputs = hole_inputs(position=constant((4, 4), 10, 0, 0))
        assert not holes(**inputs, test="paper").any()
        assert holes(**inputs, test="paper", limits=HoleLimits(facing=11)).all()
        inputs = hole_inputs(position=slope(), position_previous=slope(lift=10))
        assert not holes(**inputs).any()
        assert holes(**inputs, limits=HoleLimits(footprints=2)).all()


class TestOcclusionWarp:
    def test_a_disc_over_a_background(self):
        """A disc that moved right by 3 uncovers background; there the splat holds the disc's motion, which looks where it came from."""
        size = (9, 15)
        y, x = np.indices(size)
        disc = (x - 9) ** 2 + (y - 4) ** 2 <= 4
        was = (x - 6) ** 2 + (y - 4) ** 2 <= 4
        motion = np.where(disc[..., None], (-3.0, 0.0), (0.0, 0.0))
        depth = np.where(disc, 0.2, 0.8)
        color = np.where(was, 1.0, 0.25)[..., None]
        warped, _ = warp(color, motion)
        valid = disc | ~was
        occlusion_motion, filled = occlusion_warp(color, warped, motion, depth, valid)
        uncovered = was & ~disc
        assert uncovered.any()
        # The uncovered background shows what the disc's own motion leads to: background, 3 pixels to the left.
        np.testing.assert_array_equal(occlusion_motion[uncovered], np.broadcast_to((-3.0, 0.0), (uncovered.sum(), 2)))
        np.testing.assert_array_equal(filled[..., 0], np.where(disc, 1.0, 0.25))

    def test_what_lies_deeper_than_ten_never_splats(self):
        motion = constant((1, 2), 0.5, 0)
        depth = np.array([[10.0, np.nextafter(10, 0)]])
        assert splat(motion, depth).tolist() == [[[0, 0], [0.5, 0]]]


def reshade_inputs(width=20, **changed):
    """A row of static pixels 1 cm apart, of one material, of which none is a hole; its colours are its columns' numbers."""
    size = (1, width)
    columns = np.arange(width, dtype=np.float64)
    position = np.stack([columns, 0 * columns, 0 * columns], axis=-1)[None]
    color = np.repeat(columns, 3).reshape(*size, 3)
    return {
        "color": color,
        "warped": color + 100,
        "motion": np.zeros((*size, 2)),
        "valid": np.ones(size, bool),
        "stencil_previous": np.zeros(size),
        "stencil": np.zeros(size),
        "normal_previous": constant(size, 0, 0, 1),
        "normal": constant(size, 0, 0, 1),
        "position_previous": position,
        "position": position.copy(),
        "base_color": np.zeros((*size, 3)),
    } | changed


class TestReshade:
    """Stage reshade: a hole's own samples first, then like materials around."""

    def filled(self, inputs):
        filled = reshade(**inputs)
        assert (np.ptp(filled, axis=-1) == 0).all()
        return filled[0, :, 0]

    def test_a_hole_takes_the_mean_of_the_samples_that_show_its_surface(self):
        """Pixel 10 was between 7 and 8. Both lie 2 cm or more from it if the world has moved on, and a footprint is 1 cm."""
        inputs = reshade_inputs()
        inputs["valid"][0, 10], inputs["motion"][0, 10] = False, (-2.5, 0)
        inputs["position_previous"] = inputs["position_previous"] + (2.5, 0, 0)
        assert self.filled(inputs).tolist() == [*range(100, 110), 7.5, *range(111, 120)]
        inputs["position_previous"][0, 7, 1] = 2.0  # the root of 4.25
        assert self.filled(inputs)[10] == 8
        inputs["position_previous"][0, 7] = (10, 0, 2.0)  # exactly 2
        assert self.filled(inputs)[10] == 7.5
        inputs["stencil_previous"][0, 7] = 1
        assert self.filled(inputs)[10] == 8
        inputs["position_previous"][0, 8] = np.nan
        assert 103 < self.filled(inputs)[10] < 117  # none: from around

    def test_of_a_moving_object_the_normals_count(self):
        """Pixel 10 alone shows its object now, so that there is nothing around."""
        inputs = reshade_inputs()
        inputs["stencil"][0, 10], inputs["stencil_previous"][:] = 3, 3
        inputs["valid"][0, 10], inputs["motion"][0, 10] = False, (-2.5, 0)
        inputs["position_previous"] = inputs["position_previous"] + 1000
        assert self.filled(inputs)[10] == 7.5
        inputs["normal_previous"][0, 8] = (np.sqrt(0.2), 0, np.sqrt(0.8))
        assert self.filled(inputs)[10] == 7
        inputs["normal"][0, 10] = inputs["normal_previous"][0, 7:9] = 0  # a background
        assert self.filled(inputs)[10] == 7.5

    def test_a_moving_object_looks_around_and_its_samples_are_sources(self):
        """Pixels 8 and 10 were 5 and 8, and show one object with 12: each finds the light of the others, and both take the mean."""
        inputs = reshade_inputs(stencil_previous=np.full((1, 20), 3.0))
        inputs["stencil"][0, [8, 10, 12]] = 3
        for pixel, before in ((8, 5), (10, 8)):
            inputs["valid"][0, pixel], inputs["motion"][0, pixel, 0] = False, before - pixel
            inputs["normal_previous"][0, before + 1] = 0
        assert self.filled(inputs)[[8, 10]].tolist() == 2 * [np.mean([8, 112, 5, 112])]

    def test_a_hole_beyond_the_frame_takes_the_samples_that_are_there(self):
        inputs = reshade_inputs(position=np.zeros((1, 20, 3)), position_previous=np.zeros((1, 20, 3)))
        inputs["valid"][0, :3], inputs["motion"][0, :3] = False, ((-0.5, 0), (-2.5, 0), (np.nan, 0))
        inputs["color"][0, 0] = -1  # counts as 0
        filled = self.filled(inputs)
        assert filled[0] == 0
        lights = np.mean([103, 105, 109, 117]), np.mean([0, 104, 106, 110, 118])
        assert filled[1:3] == pytest.approx(np.mean(lights), rel=1e-15)

    @pytest.mark.parametrize(
        ("pixel", "motion", "there", "rows", "columns"),
        [
            ((1, 1), (0.5, 0.5), "1111", [1, 1, 2, 2], [1, 2, 1, 2]), ((2, 3), (0.25, 0.25), "1000", [2, 2, 2, 2], [3, 3, 3, 3]),
            ((0, 0), (-0.5, -0.5), "0001", [0, 0, 0, 0], [0, 0, 0, 0]), ((2, 1), (0.5, 1), "0000", [2, 2, 2, 2], [1, 2, 1, 2]),
            ((1, 3), (1, 0.5), "0000", [1, 1, 2, 2], [3, 3, 3, 3]), ((1, 2), (np.nan, 0), "0000", [1, 1, 2, 2], [2, 3, 2, 3]),
        ],
    )  # fmt: skip
    def test_the_four_samples_go_row_by_row(self, pixel, motion, there, rows, columns):
        """In a frame of three rows and four columns; what lies beyond is no sample, even a pixel below or to the right."""
        motions = np.zeros((3, 4, 2))
        motions[pixel] = motion
        rows_read = [(int(i[0]), r[0], c[0]) for i, r, c in four_samples(motions, *(np.array([n]) for n in pixel))]
        assert rows_read == list(zip(map(int, there), rows, columns, strict=True))

    def around(self, lit, pixel, side=150):
        """The sum and the weights around a pixel of sources of one material, of brightness 1; ``lit``: place -> colour."""
        color, is_source, white = np.zeros((side, side, 3)), np.zeros((side, side), bool), np.full((side, side, 3), 63 / 64)
        for at, value in lit.items():
            color[at], is_source[at] = value, True
        sums, totals = like_sums(color, is_source, color[..., 0] * 0, white, white, *(np.array([n]) for n in pixel))
        return sums[0, 0], totals[0, 2]

    @pytest.mark.parametrize("step", STEPS)
    def test_sources_lie_on_rings(self, step):
        middle, reach = 70, REACH * step
        near, far = middle - reach, middle + reach
        corners = {(near, near): 1, (near, far): 2, (far, near): 4, (far, far): 8, (middle, near): 16, (near, middle): 32}
        between = dict.fromkeys(((middle - 1, middle), (middle, middle + 6), (near - 1, middle), (middle, far + 1)), 1000)
        assert self.around(corners | between, (middle, middle)) == (63, 6)
        assert self.around({(y, x): 1 for y in range(150) for x in range(150)}, (middle, middle)) == (96, 96)

    @pytest.mark.parametrize(
        ("pixel", "at"), [((0, 0), (2, 0)), ((149, 0), (147, 0)), ((0, 149), (0, 85)), ((149, 149), (85, 85))]
    )
    def test_beyond_the_frame_there_is_none(self, pixel, at):
        assert self.around({at: 5}, pixel) == (5, 1)
        clamped = {(0, 1): 5, (1, 0): 5, (149, 148): 5, (148, 149): 5}
        assert self.around(clamped, (1, 1)) == self.around(clamped, (148, 148)) == (0, 0)

    def test_sources_are_added_ring_by_ring_and_row_by_row(self):
        """2^53 + 1 rounds to 2^53, where 1 + 1 comes first it is 2^53 + 2."""
        large, c = 2.0**53, 70
        for places in (
            [(c, c - 2), (c, c + 2), (c - 64, c)],
            [(c - 2, c), (c + 2, c), (c, c - 64)],
            [(c - 2, c + 2), (c, c - 2), (c, c + 2)],
            [(c + 2, c + 2), (c - 64, c), (c, c - 64)],
        ):
            assert self.around(dict(zip(places, (large, 1, 1), strict=True)), (c, c)) == (large, 3)
            assert self.around(dict(zip(places, (1, 1, large), strict=True)), (c, c)) == (large + 2, 3)

    @pytest.mark.parametrize(
        ("base", "own_base", "normal", "own", "weight"),
        [
            ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5), (0, 0, 1), (0, 0, 1), 1), ((0, 0, 0), (1, 0, 0), (0, 0, 1), (0, 0, 1), 1 / 16),
            ((0, 1, 0), (0, 0, 0), (0, 0, 1), (0, 0, 1), 1 / 16), ((0, 0, 0.5), (0.5, 0, 0.5), (0, 0, 1), (0, 0, 1), 1.5**-4),
            ((0, 0, 0), (0, 0, 0), (0.5, 0.5, 1), (0, 0, 1), 1 / 16), ((0, 0, 1), (0, 0, 0), (1, 0, 0), (0.5, 0.5, 0), 1 / 81),
        ],
    )  # fmt: skip
    def test_the_weight_of_a_material(self, base, own_base, normal, own, weight):
        """(1 + sum |b| + 2 |n|^2)^-4, of differences."""
        materials = [np.array([each], np.float64) for each in (base, own_base, normal, own)]
        assert likeness(*materials, np.zeros(1))[0] == weight
        # A background's squared distance, with the rest.
        assert likeness(*materials, np.full(1, 4.0))[0] == (weight**-0.25 + 1) ** -4

    @pytest.mark.parametrize(
        ("base", "bright"),
        [(-1, 1 / 8), (0, 1 / 8), (3 / 64, 1 / 4), (15 / 64, 1 / 2), (63 / 64, 1), (1, np.sqrt(65 / 64)), (7, np.sqrt(65 / 64))],
    )
    def test_what_a_base_colour_makes_of_light(self, base, bright):
        """A root above a floor, within 0 and 1; nothing of a mixed pixel's."""
        assert (brightness(np.full((1, 3), float(base)), np.array([False])) == bright).all()
        assert (brightness(np.full((1, 3), float(base)), np.array([True])) == 1).all()

    def test_a_mixed_normal_is_shorter_than_a_half(self):
        assert is_mixed(np.array([[0, 0, 0.5], [0, np.nextafter(0.5, 0), 0], [0, 0, 0], [0.25, 0.25, 0.25]])).tolist() == [
            0,
            1,
            1,
            1,
        ]

    @pytest.mark.parametrize(
        ("number", "n", "normal", "shows"),
        [
            (3, (0, 0, COSINE), (0, 0, 1), True), (3, (0, 0, np.nextafter(COSINE, 0)), (0, 0, 1), False),
            (3, (0, 0, 0), (0, 0, 1), False), (3, (0, 0, 1), (0, 0, 0), False), (3, (0, 0, 0), (0, 0, 0), True),
            (3, (-1, 0, 0), (-1, 0, 0), True),
        ],
    )  # fmt: skip
    def test_a_moving_surface_is_known_by_its_normal(self, number, n, normal, shows):
        stencil, position = np.full((1, 2), float(number)), np.zeros((1, 2, 3))
        before, now = ((stencil, np.array([[each, each]], np.float64), position) for each in (n, normal))
        at = np.array([0]), np.array([1])
        assert shows_surface(before, now, at, at).tolist() == [shows]

    @pytest.mark.parametrize(
        ("n", "normal", "shows"),
        [
            ((0, 0, 0.5), (0, 0, 1), True), ((0, 0, np.nextafter(0.5, 0)), (0, 0, 1), False), ((0, 0, 0), (0, 0, 1), False),
            ((0, 0, 1), (0, 0, 0), False), ((0, 0, 0), (0, 0, 0), True),
        ],
    )  # fmt: skip
    def test_a_static_surface_may_not_turn(self, n, normal, shows):
        """Not even where it lies; a background is known by having no normal, however far it is."""
        stencil, position = np.zeros((1, 2)), np.array([[[0.0, 0, 0], [1, 0, 0]]])
        there = position + (9 if not any(n) and not any(normal) else 0)
        before, now = (
            (stencil, np.array([[n, n]], np.float64), there),
            (stencil, np.array([[normal, normal]], np.float64), position),
        )
        at = np.array([0]), np.array([1])
        assert shows_surface(before, now, at, at).tolist() == [shows]

    def test_a_background_takes_from_background_by_distance(self):
        """Pixel 10 leads nowhere: of 8 and 14 the former is nearer, 2 and 4 pixels away; 12 is a surface."""
        inputs = reshade_inputs(warped=np.zeros((1, 20, 3)))
        inputs["valid"][0, 10], inputs["motion"][0, 10] = False, (np.inf, 0)
        inputs["normal"][0, [8, 10, 14]] = 0
        inputs["warped"][0, [8, 12, 14]] = [[16], [1000], [625]]
        assert self.filled(inputs)[10] == (16 / 16 + 625 / 625) / (1 / 16 + 1 / 625)
        inputs["normal"][0, 10] = inputs["normal"][0, 12]
        inputs["stencil"][0, [10, 12]] = 1  # a surface takes from none of them
        assert self.filled(inputs)[10] == 1000

    def test_a_background_counts_rows_as_columns(self):
        none, is_source, hole = np.zeros((20, 1, 3)), np.zeros((20, 1), bool), (np.array([10]), np.array([0]))
        is_source[[8, 14]] = True
        _, total = like_sums(none, is_source, none[..., 0], none, none, *hole)
        assert (total == 1 / 16 + 1 / 625).all()

    def test_without_samples_like_materials_around_count(self):
        """Pixel 10 leads nowhere. A normal 1/2 squared off halves the fourth root of a weight."""
        inputs = reshade_inputs(80, warped=np.zeros((1, 80, 3)))
        inputs["valid"][0, 10], inputs["motion"][0, 10] = False, (np.inf, 0)
        inputs["stencil"][:] = 1
        inputs["stencil"][0, [8, 10, 12, 70, 74]] = 0  # 70 is on no ring of 10
        inputs["warped"][0, [8, 12, 70, 74]] = [[1], [10], [1000], [4]]
        assert self.filled(inputs)[10] == 5
        inputs["normal"][0, 12] = (0.5, 0.5, 1)
        assert self.filled(inputs)[10] == (1 + 10 / 16 + 4) / (2 + 1 / 16)
        inputs["normal"][0, 74] = (0.5, 0.5, 1)
        assert self.filled(inputs)[10] == (1 + 10 / 16 + 4 / 16) / (1 + 2 / 16)
        inputs["valid"][0, [8, 74]] = False  # no sources, since their motion leads to other objects
        inputs["stencil_previous"][:] = 7
        assert self.filled(inputs)[[8, 10, 74]].tolist() == [10, 10, 1000]
        inputs["stencil_previous"][0, 8] = 0  # now 8 has a sample, and is a source
        assert self.filled(inputs)[8] == 8
        assert self.filled(inputs)[10] == (8 + 10 / 16) / (1 + 1 / 16)

    def lit(self, base, light=3.0):
        """Sources at 8 and 12 of base colours 3/64 and 15/64, so 1/4 and 1/2 bright, in one light; 10 is a hole of base colour ``base``."""
        inputs = reshade_inputs(warped=np.zeros((1, 20, 3)), stencil=np.ones((1, 20)))
        inputs["valid"][0, 10], inputs["motion"][0, 10] = False, (np.inf, 0)
        inputs["stencil"][0, [8, 10, 12]] = 0
        inputs["base_color"][0, [8, 10, 12]] = [[3 / 64], [base], [15 / 64]]
        inputs["warped"][0, [8, 12]] = [[light / 4], [light / 2]]
        return inputs

    @pytest.mark.parametrize(("base", "bright"), [(0, 1 / 8), (3 / 64, 1 / 4), (63 / 64, 1), (9, np.sqrt(65 / 64))])
    def test_the_light_is_that_of_other_base_colours(self, base, bright):
        """Where one light falls, a hole has the colour of its own material, which no source shows."""
        assert self.filled(self.lit(base))[10] == pytest.approx(3 * bright, rel=1e-15)

    def test_a_bright_source_tells_more_of_the_light(self):
        """Lights of 3 and 6 from sources 1/4 and 1/2 bright: by least squares the latter counts four times, by its weight besides."""
        inputs = self.lit(63 / 64)
        inputs["warped"][0, 12] = 3
        weights = (1 + 180 / 64) ** -4 / 16, (1 + 144 / 64) ** -4 / 4
        assert self.filled(inputs)[10] == pytest.approx(np.average([3, 6], weights=weights), rel=1e-15)

    def test_a_mixed_hole_takes_the_mean_of_colours(self):
        inputs = self.lit(63 / 64)
        inputs["normal"][0, [8, 10, 12], 2] = 0.25
        weights = (1 + 180 / 64) ** -4, (1 + 144 / 64) ** -4
        assert self.filled(inputs)[10] == pytest.approx(np.average([3 / 4, 3 / 2], weights=weights), rel=1e-15)

    @pytest.mark.parametrize(("second", "shares"), [(11, True), (12, True), (13, False)])
    def test_holes_within_two_pixels_share_their_lights(self, second, shares):
        """The holes 10 and ``second`` find lights of 5 and 7, from sources 2 pixels to the left and to the right."""
        inputs = reshade_inputs(warped=np.zeros((1, 20, 3)), stencil=np.ones((1, 20)))
        holes, sources = [10, second], [8, second + 2]
        inputs["valid"][0, holes], inputs["motion"][0, holes] = False, (np.inf, 0)
        inputs["stencil"][0, [*holes, *sources]] = 0
        inputs["warped"][0, sources] = [[5], [7]]
        reached = second == 12  # each is 4 pixels from the other's source, on a ring
        lights = [6, 6] if reached else [5, 7]
        assert self.filled(inputs)[holes].tolist() == ([np.mean(lights)] * 2 if shares else lights)
        inputs["normal"][0, [second, second + 2]] = (0, 0.5, 1)
        unlike = (1 + 2 * 0.25) ** -4
        if shares and not reached:
            assert self.filled(inputs)[10] == pytest.approx((5 + 7 * unlike) / (1 + unlike), rel=1e-15)
        for plane, other in (("stencil", 4), ("normal", (0, 0.25, 0))):  # another object; a mixed pixel
            apart = {**inputs, plane: inputs[plane].copy(), "warped": inputs["warped"].copy()}
            apart[plane][0, [second, second + 2]] = other
            if not reached:
                assert self.filled(apart)[holes].tolist() == [5, 7]

    def test_lights_are_shared_row_by_row(self):
        """Of 5 x 5 holes around one in the corner of a frame of three rows and four columns, six lie in the frame."""
        rows = [
            (i[:, 0].astype(int).tolist(), r[0], c[:, 0].tolist())
            for i, (r, c) in square_rows((3, 4), np.array([0]), np.array([3]))
        ]
        inside, columns = [1, 1, 1, 0, 0], [1, 2, 3, 3, 3]
        assert rows == [([0] * 5, 0, columns)] * 2 + [(inside, row, columns) for row in range(3)]

    def test_lights_are_shared_not_colours(self):
        """Two holes of base colours 3/64 and 15/64, so 1/4 and 1/2 bright, in lights of 4 and 8."""
        inputs = reshade_inputs(warped=np.zeros((1, 20, 3)), stencil=np.ones((1, 20)))
        inputs["valid"][0, [10, 11]], inputs["motion"][0, [10, 11]] = False, (np.inf, 0)
        inputs["stencil"][0, [8, 10, 11, 13]] = 0
        inputs["base_color"][0, [8, 10]], inputs["base_color"][0, [11, 13]] = 3 / 64, 15 / 64
        inputs["warped"][0, [8, 13]] = [[1], [4]]
        unlike = (1 + 36 / 64) ** -4
        assert self.filled(inputs)[10] == pytest.approx((4 + 8 * unlike) / (1 + unlike) / 4, rel=1e-15)
        assert self.filled(inputs)[11] == pytest.approx((8 + 4 * unlike) / (1 + unlike) / 2, rel=1e-15)

    def test_channels_have_lights_of_their_own(self):
        inputs = self.lit(63 / 64)
        inputs["base_color"][0, 12] = (15 / 64, 3 / 64, 0)
        inputs["warped"][0, [8, 12]] = [[1 / 4, 2 / 4, 3 / 4], [1 / 2, 2 / 4, 3 / 8]]
        assert reshade(**inputs)[0, 10] == pytest.approx([1, 2, 3], rel=1e-15)

    def test_what_has_nothing_alike_stays_as_it_is_warped(self):
        inputs = reshade_inputs(valid=np.zeros((1, 20), bool), stencil_previous=np.ones((1, 20)))
        inputs["warped"][0, 4] = -3
        assert self.filled(inputs).tolist() == [*range(100, 104), 0, *range(105, 120)]

    def test_errors_name_the_array(self):
        with pytest.raises(ArrayError, match=r"base_color: expected shape \(1, 20, 3\), got \(1, 20\)"):
            reshade(**reshade_inputs(base_color=np.zeros((1, 20))))
        with pytest.raises(ArrayError, match=r"normal: 60 non-finite values"):
            reshade(**reshade_inputs(normal=np.full((1, 20, 3), np.nan)))


class TestRRM:
    def test_a_rectangle_is_cleared(self):
        masked = rrm(np.ones((4, 5), np.uint8), (1, 2, 2, 3))
        assert masked.sum() == 20 - 6
        assert not masked[1:3, 2:5].any()
        assert masked.dtype == np.uint8

    def test_nothing_beside_it_is_cleared(self):
        """It touches no edge; and one of no height or width is none."""
        masked = rrm(np.ones((7, 7)), (1, 2, 3, 2))
        rows = ["1111111", "1100111", "1100111", "1100111", "1111111", "1111111", "1111111"]
        assert ["".join(str(int(v)) for v in row) for row in masked] == rows
        for rectangle in ((2, 3, 0, 2), (2, 3, 2, 0)):
            assert rrm(np.ones((6, 7)), rectangle).all()
        assert not rrm(np.ones((6, 7)), (0, 0, 6, 7)).any()

    def test_every_place_may_be_drawn(self):
        """What it asks of the generator: lowest and highest value, both included."""
        ranges = []

        class Highest:
            def integers(self, low, high, *, endpoint):
                ranges.append((low, high, endpoint))
                return high

        assert draw_rectangle(9, 22, Highest()) == (7, 17, 2, 5)
        assert ranges == [(1, 2, True), (1, 5, True), (0, 7, True), (0, 17, True)]

    @pytest.mark.parametrize("rectangle", [(-1, 0, 1, 1), (0, 0, 5, 1), (3, 0, 2, 1), (0, 5, 1, 1)])
    def test_a_rectangle_outside_is_an_error(self, rectangle):
        with pytest.raises(ArrayError, match="rectangle"):
            rrm(np.ones((4, 5)), rectangle)

    @given(height=st.integers(4, 90), width=st.integers(4, 90), seed=SEEDS)
    def test_drawn_rectangles_keep_the_rule(self, height, width, seed):
        y, x, h, w = draw_rectangle(height, width, np.random.default_rng(seed))
        assert 1 <= h <= height // 4
        assert 1 <= w <= min(height * width // (16 * h), width // 4)
        assert 0 <= y <= height - h
        assert 0 <= x <= width - w
        assert h * w * 16 <= height * width

    def test_too_small_a_mask_is_an_error(self):
        with pytest.raises(ArrayError, match="at least 4 x 4, got 3 x 9"):
            draw_rectangle(3, 9, np.random.default_rng(0))


class TestAccumulate:
    def shown(self, image, *pairs):
        """One channel of a row of two pixels, four on the display, whose two rows are equal; ``pairs``: an earlier image, its motion."""
        rows = [np.broadcast_to(np.array(row, float)[None, :, None], (2, 4, 1)) for row in (image, *(row for row, _ in pairs))]
        motions = np.stack([np.broadcast_to(np.array([motion, 0.0]), (1, 2, 2)) for _, motion in pairs])
        shown = accumulate(rows[0], np.stack(rows[1:]), motions)
        assert (shown[0] == shown[1]).all()
        return shown[0, :, 0].tolist()

    def test_a_quarter_of_the_newer_image(self):
        assert self.shown([0, 8, 0, 8], ([4, 4, 4, 4], 0)) == [1, 7, 1, 7]

    def test_and_an_eighth_of_the_older(self):
        assert self.shown([0, 8, 0, 8], ([4, 4, 4, 4], 0), ([8, 8, 0, 4], 0)) == [2, 7, 1, 6.5]

    def test_each_is_within_what_surrounds_the_pixel(self):
        """Not their mean."""
        assert self.shown([0, 8, 9, 9], ([100, 100, -100, -100], 0)) == [2, 8.25, 8.75, 9]
        assert self.shown([0, 8, 8, 8], ([100, 0, 8, 8], 0), ([-100, 0, 8, 8], 0))[0] == 2

    def test_a_display_pixel_has_twice_the_motion(self):
        """Half a pixel is one on the display; the last pixel's leads out of the frame."""
        assert self.shown([0, 8, 0, 8], ([1, 2, 3, 4], 0.5)) == [0.5, 6.75, 1, 8]
        assert self.shown([0, 8, 0, 8], ([1, 2, 3, 4], 0.25))[0] == 0.375

    def test_each_image_has_its_motion(self):
        assert self.shown([0, 8, 0, 8], ([1, 2, 3, 4], 0.5), ([1, 2, 3, 4], 1))[:2] == [0.875, 6.25]

    @pytest.mark.parametrize("motion", [np.nan, np.inf, -9.0, 1e30])
    def test_off_screen_is_the_image(self, motion):
        assert self.shown([0, 8, 0, 8], ([4, 4, 4, 4], motion)) == [0, 8, 0, 8]
        assert self.shown([0, 8, 0, 8], ([4, 4, 4, 4], motion), ([4, 4, 4, 4], 0)) == [0.5, 7.5, 0.5, 7.5]

    def test_what_moves_by_more_than_4_pixels_is_mixed_less(self):
        motion = np.array([[(0, 0), (4, 0), (0, -8), (3, 4), (-12, 16), (np.inf, 0), (1e200, 0)]])
        np.testing.assert_allclose(slowness(motion)[0, :, 0], [1, 1, 1 / 4, 16 / 25, 1 / 25, 0, 0], rtol=2**-50)
        image, motions = np.tile([0.0, 8.0], (2, 24))[..., None], np.zeros((2, 1, 24, 2))
        motions[:, 0, 0, 0] = 8, 16
        shown = accumulate(image, np.stack([8 - image] * 2), motions)[0, :4, 0]
        assert shown.tolist() == [8 / 16 + 8 / 128, 8 - 8 / 16 - 8 / 128, 3, 5]

    def test_rows_are_read_as_columns_are(self):
        rng = np.random.default_rng(0)
        image, earlier, motions = rng.random((6, 10, 2)), rng.random((2, 6, 10, 2)), rng.uniform(-1, 1, (2, 3, 5, 2))
        turned = accumulate(image.swapaxes(0, 1), earlier.swapaxes(1, 2), motions.swapaxes(1, 2)[..., ::-1])
        np.testing.assert_allclose(turned.swapaxes(0, 1), accumulate(image, earlier, motions), rtol=0, atol=2**-50)

    def test_its_dtype_is_the_images(self):
        arrays = np.ones((2, 4, 3), np.float32), np.ones((1, 2, 4, 3), np.float32), np.zeros((1, 1, 2, 2), np.float32)
        assert accumulate(*arrays).dtype == np.float32

    def test_more_than_two_are_an_error(self):
        with pytest.raises(ArrayError, match="earlier: expected at most 2 images, got 3"):
            accumulate(np.ones((2, 4, 3)), np.ones((3, 2, 4, 3)), np.zeros((3, 1, 2, 2)))


class TestDepth:
    def test_background_takes_the_largest_real_depth(self):
        depth = np.array([[0.0, 2.0], [1e10, 4.0], [np.inf, np.nan], [-1.0, 3.0]])
        scaled = normalise_depth(depth, "scale")
        np.testing.assert_array_equal(scaled, (np.array([[4.0, 2], [4, 4], [4, 4], [4, 3]]) - 2) / (2 + 1e-6))
        np.testing.assert_array_equal(normalise_depth(depth / 8, "clip")[0], [0.5, 0.25])

    def test_where_the_background_begins(self):
        """At 1e9; and what is farther than 1 is 1."""
        depth = np.array([[1e9, 1.1e9, 1.5, 0.5]])
        np.testing.assert_array_equal(normalise_depth(depth, "clip"), [[1, 1, 1, 0.5]])
        np.testing.assert_array_equal(normalise_depth(depth, "scale"), (np.array([[1.5, 1.5, 1.5, 0.5]]) - 0.5) / (1 + 1e-6))

    def test_constant_and_empty_frames(self):
        np.testing.assert_array_equal(normalise_depth(np.full((2, 2), 5.0), "scale"), np.zeros((2, 2)))
        np.testing.assert_array_equal(normalise_depth(np.full((2, 2), np.inf), "clip"), np.ones((2, 2)))


def test_the_reference_has_the_properties_that_the_judge_asks_for():
    stages = ("motion_chain", "warp", "holes", "occlusion_warp", "reshade", "rrm")
    results = run_suite(Judge(ReferencePort(), Tier("some", 15, 1, 0)), stages)
    assert len(results) > 30
    assert not [f"{result.id}: {result.message}" for result in results if result.outcome != "passed"]
