# SPDX-License-Identifier: MIT
"""Whether motion, depth and normals agree with the positions: the position of a static point must be the same in both frames."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from stss.check_sequence.background_verdict import BackgroundVerdict, common_verdict, measure_background
from stss.check_sequence.jitter import ALIKE, Jitter, common_shift
from stss.check_sequence.late_planes import LatePlanes, late_lines
from stss.check_sequence.normal_directions import NormalVerdict, judge_normals
from stss.check_sequence.sky_means import SkyMeans, sky_lines
from stss.check_sequence.value_statistics import Line
from stss.frames.buffers import Buffers
from stss.frames.static_holes import static_holes
from stss.sequence.background import LOOSE, static_surfaces
from stss.sequence.projection import Projection, solve_projection
from stss_ref.arrays import Array
from stss_ref.holes import holes
from stss_ref.sample import follow, leads_inside

NEAR = 1e-2
"""Share of the distance to the surfaces, below which the camera is at the origin."""
AGREES = 0.1
"""Pixels: the largest median error of motion that agrees with the positions, or three times the positions' own error."""
BETTER = 0.25
"""Another meaning of the motion is named if its error is below this share of the stored motion's."""
MOST_JUDGED = 1 << 17
"""Pixels, spread over all, by which other meanings are judged: of a million, thirty meanings take seconds."""
MOVES = 0.25
"""Pixels: a smaller motion allows no judgement."""
MANY = 0.2
"""Share of holes among static surfaces, from which there is a warning, if motion and positions agree."""
PROPORTIONAL = 0.05
"""Largest median deviation of depths from the distance along the view, as a share of it."""
ONE_DISTANCE = 1e-3
"""Least spread of these distances that tells something, as a share of them."""
MOVERS = 0.01
"""Share of the surfaces with stencil 0 that move by themselves, from which there is a warning."""
MOVER = 0.5
"""Pixels: a surface moves by itself if its motion and those of all its neighbours differ by more from the positions' motion."""


@dataclass(frozen=True)
class StaticVerdict:
    """Facts about the other buffers, from the positions of static geometry.

    Attributes:
        pixels: how many were compared.
        residual: median distance of a pixel to where its own position is projected; pixels.
        error: median error of the stored motion; pixels.
        motion: the likely convention of the stored motion, if it fits clearly better; empty otherwise.
        relative: positions begin at the camera in every frame, although motion says that the camera moves.
        fit: true motion over stored motion by least squares, ``(scale, offset)`` for x and y.
        depth: median deviation from the distance along the view; -1 where depth falls with distance.
        normals: the verdict on them, the median of each fact over the frames.
        holes: share of the static surfaces that are holes, over one frame; motion that leads off the frame does not count.
        movers: share of the static surfaces whose motion is not that of static geometry, while the motion of the others is.
    """

    pixels: int
    residual: float
    error: float
    motion: str
    relative: bool
    fit: tuple[tuple[float, float], ...]
    depth: float
    normals: NormalVerdict
    holes: float
    movers: float

    @property
    def agrees(self) -> bool:
        """Whether the stored motion agrees with the positions."""
        return self.error <= max(AGREES, 3 * self.residual)

    def lines(self) -> list[Line]:
        """Findings."""
        if self.residual > LOOSE:
            return [
                (
                    "note",
                    f"position: no camera fits them better than to {self.residual:.2g} pixels; they prove nothing",
                )
            ]
        return [*self._motion(), *self._holes(), *self._others()]

    def _motion(self) -> list[Line]:
        if self.relative and not self.agrees:
            return [
                (
                    "warning",
                    "position: relative to the camera, or in view space: the camera is at (0, 0, 0) in every frame, but motion says that "
                    "it moves; holes will be wrong: write world positions, with the camera's position added",
                )
            ]
        over = f"by the positions of {self.pixels} static pixels"
        if self.agrees:
            return [("note", f"motion: right to {self.error:.2g} pixels, {over}")]
        fits = "; ".join(f"true {axis} = {s:.4g} x stored {o:+.2g}" for axis, (s, o) in zip("xy", self.fit, strict=True))
        what = f"seems to be {self.motion}" if self.motion else f"is off by {self.error:.2g} pixels"
        return [("warning", f"motion: {what}, {over} ({fits})")]

    def _holes(self) -> list[Line]:
        text = f"holes: {self.holes:.1%} of the static surfaces, from one frame to the next"
        if self.agrees and self.holes > MANY:
            return [("warning", f"{text}, though motion and positions agree: do positions have steps, or noise?")]
        return [("note", text)]

    def _others(self) -> list[Line]:
        lines: list[Line] = []
        if self.agrees and self.movers > MOVERS:
            text = f"stencil: 0 on {self.movers:.1%} of the surfaces, though their motion shows that they move"
            lines.append(("warning", f"{text}: give every moving object a number above 0, or is their motion wrong?"))
        if self.depth < 0:
            lines.append(
                ("warning", "depth: falls where the distance of positions grows; expected linear depth, it looks reversed")
            )
        elif self.depth > PROPORTIONAL:
            text = f"depth: {self.depth:.0%} off a depth in proportion to the view distance of positions"
            lines.append(("warning", f"{text}; expected linear depth, not that of a depth buffer"))
        return (
            lines if self.relative and not self.agrees else [*lines, *self.normals.lines()]
        )  # those of the camera have its axes


@dataclass(frozen=True)
class StaticGeometry:
    """Findings from static geometry.

    Attributes:
        positions: the verdict by positions; None where no pair shows enough static geometry.
        jitter: of the camera.
        repeats: frames with the positions of the previous frame, though something moves.
        apart: frames whose motion does not lead to the frame before, though that of the others does.
        late: the planes that are those of the previous frame.
        background: the verdict on it; None where there is none, or the scene is flat.
        sky_means: share of the static pixels along it whose position and depth are means with its 0.
    """

    positions: StaticVerdict | None
    jitter: Jitter
    repeats: tuple[int, ...]
    apart: tuple[int, ...]
    late: tuple[str, ...]
    background: BackgroundVerdict | None
    sky_means: float

    @property
    def blames_motion(self) -> bool:
        """Whether all motion is wrong, by positions."""
        of = self.positions
        return of is not None and "position" not in self.late and of.residual <= LOOSE and not (of.agrees or of.relative)

    @property
    def _has_motion(self) -> bool:
        """Whether the motion of infinitely far points can be judged by itself."""
        of = self.positions
        return of is None or of.agrees or (of.residual > LOOSE)

    def left_of(self, lines: list[Line]) -> list[Line]:
        """The ``lines`` about motion by other planes that remain beside the verdict by positions: one mistake has one name."""
        if self.positions is None or not self.blames_motion:
            return lines
        return [] if self.positions.motion else [line for line in lines if line[0] == "warning"]

    def lines(self) -> list[Line]:
        """Findings."""
        repetition = f"position: frames {', '.join(map(str, self.repeats))} repeat that of the previous frame"
        return [
            *([("warning", f"{repetition}; every display frame needs its own G-buffer")] if self.repeats else []),
            *late_lines(self.late),
            *([] if "position" in self.late else self._by_positions()),  # they are not those of the surfaces that are static now
        ]

    def _by_positions(self) -> list[Line]:
        lines = [] if self.positions is None else self.positions.lines()
        apart = f"frame{'s' if len(self.apart) > 1 else ''} {', '.join(map(str, self.apart))}"
        text = f"motion: wrong in {apart} alone, by positions: a cut there (--cuts), or a frame of another version?"
        return [
            *([("warning", text)] if self.apart else []),
            *(line for line in lines if not line[1].startswith(self.late)),  # a late plane is off, but by less
            *([] if self.background is None or not self._has_motion else self.background.lines()),
            *sky_lines(self.sky_means),
            *(("warning", text) for text in self.jitter.lines),
        ]


def judge_static_geometry(pairs: Iterable[tuple[Buffers, Buffers]]) -> StaticGeometry:
    """Look at pairs of neighbouring frames (t - 1, t), one in memory at a time."""
    samples: list[tuple[Array, ...]] = []
    single: list[tuple[float, ...]] = []
    against: list[tuple[float, float]] = []
    within: list[tuple[float, float]] = []
    repeats: list[int] = []
    errors: dict[int, float] = {}
    sky: list[BackgroundVerdict] = []
    late, sky_means = LatePlanes(), SkyMeans()
    size, mirrored, relative = (0, 0), None, True
    for before, now in pairs:
        size = now.size
        still = (now.stencil == 0) & np.isfinite(now.depth) & np.isfinite(now.motion).all(axis=-1)
        if (shift := common_shift(now.motion[still].astype(np.float64), share=ALIKE)) is not None:
            within.append(shift)
        if _is_repeated(before, now):
            repeats.append(now.number)
            continue
        late.add(before, now)
        earlier, current = (solve_projection(f.position, static_surfaces(f)) for f in (before, now))
        if earlier is None or current is None:
            continue
        if len(earlier.axes) == len(current.axes) == 3 and max(earlier.residual, current.residual) <= LOOSE:
            sky += measure_background(earlier, current, now)
            sky_means.add(now, current)
        static = still & static_surfaces(now)
        there, away = earlier.project(now.position[static].astype(np.float64))
        visible = (away > 0) & (there >= 0).all(axis=-1) & (there <= (size[1] - 1, size[0] - 1)).all(axis=-1)
        if not visible.any():
            continue
        relative &= all(_at_origin(*of) for of in ((earlier, before), (current, now)))
        mirrored, here = current.mirrored, np.argwhere(static)[visible, ::-1]
        motions = [motion[static].astype(np.float64)[visible] for motion in (now.motion, np.nan_to_num(now.motion[::-1]))]
        samples.append((there[visible] - here, *motions))
        errors[now.number] = _error(there[visible] - here, motions[0])
        if (shift := common_shift(there[visible] - here - motions[0])) is not None:
            against.append(shift)
        surfaces = before.stencil, now.stencil, before.normal, now.normal, before.position, now.position
        valid, inside = holes(now.motion, *surfaces, now.nov, now.depth), leads_inside(follow(now.motion))
        share = static_holes(np.where(inside, now.stencil, 1), now.normal, valid) or 0.0
        movers = _movers(here[:, ::-1], np.linalg.norm(there[visible] - here - motions[0], axis=-1), size)
        normals = judge_normals(now, current)
        single.append((max(earlier.residual, current.residual), _depth(now, current), share, movers, *astuple(normals)))
    positions = _verdict(samples, single, size, mirrored=mirrored, relative=relative) if samples else None
    limit = np.inf if positions is None or not positions.agrees else max(MOVER, 3 * positions.residual)
    apart = tuple(number for number, error in errors.items() if error > limit)
    return StaticGeometry(
        positions,
        Jitter(tuple(against), tuple(within)),
        tuple(repeats),
        apart,
        late.names,
        common_verdict(sky),
        sky_means.share,
    )


def _at_origin(projection: Projection, frame: Buffers) -> bool:
    """Whether positions put the camera at (0, 0, 0), to a share of the distance to the surfaces."""
    camera = projection.camera
    if camera is None:
        return False
    away = np.linalg.norm(frame.position[static_surfaces(frame)].astype(np.float64) - camera, axis=-1)
    return bool(np.linalg.norm(camera) < NEAR * np.median(away))


def _verdict(
    samples: list[tuple[Array, ...]],
    single: list[tuple[float, ...]],
    size: tuple[int, int],
    *,
    mirrored: bool | None,
    relative: bool,
) -> StaticVerdict:
    true, motion, reversed_rows = (np.concatenate(of) for of in zip(*samples, strict=True))
    residual, depth, share, movers, *angles = (float(np.median(of)) for of in zip(*single, strict=True))
    some = slice(None, None, -(-len(true) // MOST_JUDGED))
    guesses = _guesses(motion[some], reversed_rows[some], size, mirrored=mirrored)
    errors = {what: _error(true[some], guess) for what, guess in guesses.items() if what}
    own, best = _error(true, motion), min(errors, key=lambda what: errors[what])
    fit = tuple(_line(true[:, k], motion[:, k]) for k in (0, 1))
    half, tells = _half_a_pixel(fit), errors[best] <= min(BETTER * own, max(AGREES, 3 * residual))
    best, tells = half or best, tells or bool(half)
    # A rotation alone moves all pixels as positions do.
    relative = relative and _not_linear(motion, true) > max(AGREES, 3 * residual)
    moves, claims = (float(np.median(np.linalg.norm(of, axis=-1))) for of in (true, motion))
    if not motion.any() and moves > MOVES:
        best, tells = "0, though the camera moves", True
    if moves <= 3 * residual and claims > MOVES:
        best, tells = "right if positions are the camera's: are they in view space, or relative to the camera?", True
    return StaticVerdict(
        len(true), residual, own, best if tells else "", relative, fit, depth, NormalVerdict(*angles), share, movers
    )


def _movers(places: NDArray[np.intp], apart: Array, size: tuple[int, int]) -> float:
    """The share of places (N, 2) that move by themselves: they and all eight pixels around differ from the positions' motion.

    ``apart`` (N,) is the difference. A silhouette, on which renderers average motion, is thinner than three pixels.
    """
    moves = np.zeros(size, np.bool_)
    moves[tuple(places[apart > MOVER].T)] = True
    return (
        float(np.lib.stride_tricks.sliding_window_view(moves, (3, 3)).all(axis=(-1, -2)).sum()) / len(places)
        if min(size) > 2
        else 0.0
    )


def _is_repeated(before: Buffers, now: Buffers) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.linalg.norm(now.motion.astype(np.float64), axis=-1)
    if not (np.isfinite(now.depth).any() and np.isfinite(steps).any()):  # then nothing is seen, in both, or nothing is claimed
        return False
    claims = np.median(steps[~np.isnan(steps)])
    same = (np.array_equal(getattr(before, of), getattr(now, of), equal_nan=True) for of in ("position", "normal", "base_color"))
    return bool(claims > MOVES) and all(same)


def _guesses(motion: Array, reversed_rows: Array, size: tuple[int, int], *, mirrored: bool | None) -> dict[str, Array]:
    """Meaning of the stored motion -> the true motion in that case; "": the stored motion is right."""
    sides = np.array(size[::-1], np.float64)
    scales = {
        "": 1.0,
        'in NDC, where 2 is the frame\'s side (unit = "ndc")': sides / 2,
        'in UV, where 1 is the frame\'s side (unit = "uv")': sides,
        'in pixels, and taken for UV (unit = "pixels")': 1 / sides,
        'in pixels, and taken for NDC (unit = "pixels")': 2 / sides,
        "twice too long: in pixels of the output, over two frames, or in NDC and taken for UV": 0.5,
        "half too long": 2.0,
    }
    signs = {"": (1, 1), "from the previous frame to this one": (-1, -1), "with y up": (1, -1), "with x to the left": (-1, 1)}
    guesses = {", ".join(filter(None, (a, b))): motion * scale * sign for a, scale in scales.items() for b, sign in signs.items()}
    guesses["x and y swapped"] = motion[:, ::-1]
    guesses["upside down: only its rows run from the bottom to the top"] = reversed_rows
    if mirrored:  # or the world is left-handed, but then y is right
        guesses["right if the file is upside down"] = guesses.pop("with y up")
    return guesses


def _half_a_pixel(fit: Iterable[tuple[float, float]]) -> str:
    """A finding where the fit is an offset of half a pixel; else empty."""
    words = ("left", "", "right"), ("upper", "", "lower")
    sides: list[str] = []
    for (scale, offset), names in zip(fit, words, strict=True):
        steps = round(-2 * offset)
        if abs(scale - 1) > AGREES or abs(2 * offset + steps) > AGREES or abs(steps) > 1:
            return ""
        sides.append(names[steps + 1])
    across, down = sides
    return f"half a pixel too far to the {' '.join(filter(None, (down, across)))}" if across or down else ""


def _error(true: Array, guess: Array) -> float:
    return float(np.median(np.linalg.norm(true - guess, axis=-1)))


def _not_linear(of: Array, by: Array) -> float:
    """The median distance of motions (N, 2) from the best linear function of others."""
    terms = np.column_stack([by, np.ones(len(by))])
    return _error(of, terms @ np.linalg.lstsq(terms, of, rcond=None)[0])


def _line(true: Array, motion: Array) -> tuple[float, float]:
    """Scale and offset of a straight line, without the pixels that fit worst."""
    is_inlier = np.ones(len(true), np.bool_)
    scale, offset = 1.0, 0.0
    for _ in range(3):
        spread = float(motion[is_inlier].std())
        scale = float(np.cov(true[is_inlier], motion[is_inlier], bias=True)[0, 1]) / spread**2 if spread > 0 else 0.0
        offset = float(np.mean(true[is_inlier] - scale * motion[is_inlier]))
        error = np.abs(true - scale * motion - offset)
        is_inlier = error <= max(3 * float(np.median(error)), 1e-6)
    return scale, offset


def _depth(frame: Buffers, projection: Projection) -> float:
    """Median deviation of a frame's depths from a multiple of the distances that its positions have along the view.

    -1: the depths fall as these distances grow. 0: all distances are alike, as for an orthographic camera at infinity; the positions then
    say nothing about depth.
    """
    mask = static_surfaces(frame)
    if mask.sum() < 2:
        return np.inf
    away = projection.project(frame.position[mask].astype(np.float64))[1]
    depth = frame.depth[mask].astype(np.float64)
    if np.std(away) < ONE_DISTANCE * np.median(away):
        return 0.0
    if np.cov(depth, away)[0, 1] < 0:
        return -1.0
    scale = float(np.median(depth / away))
    return float(np.median(np.abs(depth / (scale * away) - 1)))
