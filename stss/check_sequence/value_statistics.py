# SPDX-License-Identifier: MIT
"""Findings about the values of a few frames: units, ranges, missing data."""

from __future__ import annotations

from collections import Counter
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stss.check_sequence.motion_convention import ConventionVerdict
from stss.frames.buffers import Buffers
from stss.frames.check_buffers import ROUNDING
from stss.frames.output import choose_rendered
from stss.images.color import LARGEST
from stss.images.headers import read_header
from stss.images.read_write import WHOLE
from stss.sequence.background import CameraError
from stss.sequence.profiles import BUFFERS
from stss.sequence.raw_frame import FINITE, UNIT_RANGE, NonFinite, read_stored
from stss.sequence.sequence import Sequence
from stss_ref.arrays import Array, Mask
from stss_ref.holes import squared_footprint

Level = Literal["error", "warning", "note"]
Line = tuple[Level, str]

FINE = 1 / 8
"""Largest steps of positions, as a share of a footprint, since the hole test compares offsets with one and a half."""


def motion_lines(verdict: ConventionVerdict, profile: str) -> list[Line]:
    """Findings about the motion convention of ``profile``, such as "profile blender", from the warped frames."""
    if not verdict.pixels:
        return [("note", "motion: cannot tell whether its signs are right; too little moves, or nothing has texture")]
    comparison = f"base colour and normal of the previous frame, warped, over {verdict.pixels} pixels"
    if verdict.better is None:
        return [("note", f"motion: fits as {profile} says ({comparison}: {verdict.error:.4f})")]
    times = 1 / max(verdict.ratios[verdict.better], 1e-3)
    text = f"motion: fits {times:.1f} times as well with {verdict.better}, so {profile} seems wrong ({comparison})"
    return [("warning", text)]


OVEREXPOSED = 0.75
"""Share of the surfaces' colour values above 1, from which there is a warning. Found: up to 0.01 in the reference films."""
FEW, STILL = 16, 0.5
"""Pixels of an object whose middle says where it is; and by how many pixels samples at its silhouette move the middle, at most."""
WHOLE_HALF = 1 << 11
"""A half holds every whole number up to this one."""


NEIGHBOURS = 2
"""Frames from one colour to the next at half rate."""


def _black(numbers: list[int]) -> str:
    return f"colour: black in frame{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers[:8]))}"


class Values:
    """Counts and largest values over the checked frames."""

    def __init__(self):
        self._counts: Counter[str] = Counter()
        self._most: dict[str, float] = {}
        self._stencils: set[float] = set()
        self._non_finite: dict[str, str] = {}
        self._footprints: list[float] = []
        self._black: list[int] = []
        """The numbers of frames in which nothing was hit, and that are black: as farms leave those that failed."""
        self._light: dict[int, float] = {}
        """The number of each frame that has a colour and shows surfaces of a base colour -> the mean of its colours; 0 if all are 0."""
        self._before: tuple[int, Array, NDArray[np.intp]] | None = None
        """The number of the last frame, the object numbers in it, and the pixels of each."""
        self._middles: tuple[int, dict[float, Array]] = (0, {})
        """The number of the last frame, and of each object in it the middle of its pixels, (x, y)."""

    def add(self, sequence: Sequence, number: int) -> None:
        """Look at one frame."""
        frame = sequence.frames[number]
        planes = read_stored(frame, sequence.canvas, sequence.constants)[0]
        try:
            buffers = sequence.load(number)
        except CameraError:  # which is a finding of its own
            buffers = sequence.load(number, cut=True)
        hit = np.isfinite(buffers.depth)
        self._count_non_finite(planes, hit, number)
        self._count_outside(planes, hit)
        self._add_background(planes["depth"][..., 0], hit)
        self.add_buffers(buffers)

    def add_buffers(self, buffers: Buffers) -> None:
        """Look at one frame that was not read from files."""
        hit, count = np.isfinite(buffers.depth), self._counts
        count["pixels"] += hit.size
        count["hit"] += int(hit.sum())
        length = np.linalg.norm(buffers.normal.astype(np.float64), axis=-1)
        count["not unit"] += int((hit & (np.abs(length - 1) > 0.01)).sum())
        count["negative normals"] += int((buffers.normal < 0).any(axis=-1).sum())
        count["facing away"] += int((hit & (buffers.nov < -0.1)).sum())
        count["fractional stencils"] += int((buffers.stencil != np.rint(buffers.stencil)).sum())
        count["negative stencils"] += int((buffers.stencil < 0).sum())
        self._count_new_objects(buffers)
        self._add_middles(buffers)
        if buffers.color is not None and not (hit.any() or buffers.color.any()):
            self._black.append(buffers.number)
        if buffers.color is not None and buffers.base_color[hit].any():
            self._light[buffers.number] = float(np.abs(buffers.color).mean(dtype=np.float64))
        if hit.any():
            farthest = buffers.depth == buffers.depth[hit].max()
            count["farthest without normal"] += int((farthest & (buffers.normal == 0).all(axis=-1)).sum())
            self._highest("depth", buffers.depth[hit])
            self._highest("base colour", buffers.base_color[hit])
            self._highest("normal", np.abs(buffers.normal[hit]))
        if len(self._stencils) <= 256:
            self._stencils |= {float(x) for x in np.unique(buffers.stencil[hit])}
        with np.errstate(over="ignore", invalid="ignore"):
            moved = np.abs(buffers.motion).max(axis=-1)
        count["off the frame"] += int((hit & ~(moved < max(buffers.size))).sum())
        self._highest("motion", moved)
        self._highest("stencil", buffers.stencil)
        self._highest("position", np.abs(buffers.position[hit]))
        footprints = np.sqrt(squared_footprint(buffers.position)[hit & np.isfinite(buffers.position).all(axis=-1)])
        if footprints.size:
            self._footprints.append(float(np.median(footprints)))
        self._add_color(buffers, hit)

    def _count_new_objects(self, buffers: Buffers) -> None:
        """Count the pixels of moving objects, and of renumbered ones: at most as many as lost a number, since objects may also enter."""
        numbers, pixels = np.unique(buffers.stencil[buffers.stencil != 0], return_counts=True)
        if self._before is not None and self._before[0] == buffers.number - 1:
            _, earlier, covered = self._before
            new, gone = pixels[~np.isin(numbers, earlier)].sum(), covered[~np.isin(earlier, numbers)].sum()
            self._counts["moving"] += int(pixels.sum())
            self._counts["new objects"] += int(min(new, gone))
        self._before = buffers.number, numbers, pixels

    def _add_middles(self, buffers: Buffers) -> None:
        """Measure how far objects move, by the middles of their pixels; those of a few pixels are left out."""
        numbers, of, pixels = np.unique(buffers.stencil, return_inverse=True, return_counts=True)
        rows = [np.bincount(of.ravel(), axis.ravel()) / pixels for axis in reversed(np.indices(buffers.size))]
        of_frame = {float(n): middle for n, middle, p in zip(numbers, np.stack(rows, -1), pixels, strict=True) if n and p >= FEW}
        number, earlier = self._middles
        if number == buffers.number - 1 and not buffers.cut:
            for n in of_frame.keys() & earlier.keys():
                self._highest("shift", np.array([np.linalg.norm(of_frame[n] - earlier[n])]))
        self._middles = buffers.number, of_frame

    def _add_color(self, buffers: Buffers, hit: Mask) -> None:
        if buffers.color is not None:
            self._counts["lit values"] += 3 * int(hit.sum())
            self._counts["lit above 1"] += int((buffers.color[hit] > 1).sum())
            self._counts["colour values"] += buffers.color.size
            self._counts["negative colours"] += int((buffers.color < 0).sum())
            self._highest("color", buffers.color)

    def _add_background(self, depth: Array, hit: Mask) -> None:
        background = depth[~hit]
        with np.errstate(invalid="ignore"):
            self._counts["background 0 or less"] += int((background <= 0).sum())
            self._counts["background not finite"] += int((~np.isfinite(background)).sum())
            self._counts["background far"] += int((np.isfinite(background) & (background > 0)).sum())

    def _count_non_finite(self, planes: dict[str, Array], hit: Mask, number: int) -> None:
        """Count them where they matter: where nothing was hit, only the colour, motion and depth of a file are used."""
        for buffer in BUFFERS:
            where = ... if buffer in ("color", "motion", "depth") else hit
            bad = int((~np.isfinite(planes[buffer][where])).sum()) if buffer in planes else 0
            if bad:
                self._counts[f"non-finite {buffer}"] += bad
                self._non_finite.setdefault(buffer, f"frame {number}")

    def _count_outside(self, planes: dict[str, Array], hit: Mask) -> None:
        for buffer in UNIT_RANGE:
            values = planes[buffer][hit]
            with np.errstate(invalid="ignore"):
                self._counts[f"outside {buffer}"] += int(((values < -ROUNDING) | (values > 1 + ROUNDING)).any(axis=-1).sum())
            self._highest(buffer, values)

    def _highest(self, key: str, values: Array) -> None:
        finite = values[np.isfinite(values)]
        if finite.size:
            self._most[key] = max(self._most.get(key, -np.inf), float(finite.max()))

    def table(self) -> dict[str, object]:
        """Counts and largest values, ready for JSON."""
        return {**self._counts, **{f"largest {key}": value for key, value in self._most.items()}}

    def _share(self, key: str, of: str = "hit") -> float:
        return self._counts[key] / max(self._counts[of], 1)

    def lines(self, sequence: Sequence, non_finite: NonFinite) -> list[Line]:
        """Findings."""
        if not self._counts["pixels"]:
            return [("note", "no frame is complete, so no values were checked")]
        self._leave_out_gbuffer_frames(sequence)
        return [
            *self._non_finite_lines(non_finite),
            *self._outside_lines(),
            *self._geometry_lines(sequence),
            *self._position_lines(sequence),
            *self.color_lines(linear=sequence.profile.color_domain == "linear"),
        ]

    def _non_finite_lines(self, policy: NonFinite) -> list[Line]:
        lines: list[Line] = []
        for buffer, first in self._non_finite.items():
            text = f"{buffer}: {self._counts[f'non-finite {buffer}']} non-finite values, first in {first}"
            if buffer not in FINITE:
                meaning = {"motion": "off screen", "depth": "nothing hit", "position": "a hole"}[buffer]
                # Without a position no pixel is followed; motion has a line of its own, in which large ones count too.
                most = buffer == "position" and self._counts[f"non-finite {buffer}"] > self._counts["hit"] / 2
                lines.append(("warning" if most else "note", f"{text}; taken as {meaning}"))
            elif policy == "refuse":
                lines.append(("error", f"{text}; a run refuses them; --non-finite mask takes them as 0"))
            else:
                lines.append(("warning", f"{text}; masked"))
        return lines

    def _outside_lines(self) -> list[Line]:
        """Findings about values that reading clips."""
        lines: list[Line] = []
        for buffer in UNIT_RANGE:
            if share := self._share(f"outside {buffer}"):
                text = f"{buffer}: {share:.1%} of the pixels outside 0 to 1, the largest value {self._most[buffer]:.4g}; clipped"
                lines.append(("warning" if share > 0.01 else "note", text))
        return lines

    def _geometry_lines(self, sequence: Sequence) -> list[Line]:
        prefix, counts = "background ", self._counts
        kinds = [f"{counts[key]} {key.removeprefix(prefix)}" for key in counts if key.startswith(prefix) and counts[key]]
        listing = f", stored as: {', '.join(kinds)}" if kinds else ""
        lines: list[Line] = [("note", f"depth: {1 - self._share('hit', 'pixels'):.1%} background{listing}")]
        ray = sequence.profile.depth.kind == "ray"
        if ray and not any(f.camera is not None and f.camera.to_camera is not None for f in sequence.frames.values()):
            lines.append(("note", "depth: a ray's length, used as it is; the files have no worldToCamera to make it planar"))
        return lines + self.buffer_lines(sequence.profile.hints.get("motion")) + self._merged_lines(sequence)

    def buffer_lines(self, hint: str | None = None) -> list[Line]:
        """Findings that need no files; ``hint``: what to do where no motion was rendered."""
        lines = self._black_lines()
        if not self._counts["hit"]:
            lines.append(("warning", "depth: nothing was hit anywhere; expected linear depths > 0"))
        elif self._most.get("normal") == 0:
            lines.append(("warning", "normal: 0 everywhere"))
        elif not self._counts["negative normals"] and self._share("not unit") > 0.5:  # else no such side is in sight
            lines.append(("warning", "normal: no negative component anywhere; expected -1..1, it looks like 0..1"))
        elif share := self._share("not unit"):
            level: Level = "warning" if share > 0.2 else "note"
            lines.append((level, f"normal: {share:.1%} of the pixels not of unit length"))
        if (share := self._share("farthest without normal")) > 0.01:
            text = f"depth: {share:.1%} of the pixels at the largest depth, {self._most['depth']:.6g}, and without a normal"
            lines.append(
                (
                    "warning",
                    f"{text}: if nothing was hit there, give a profile with this background; depth must be infinite there",
                )
            )
        if self._most.get("base colour") == 0:
            lines.append(("warning", "base_color: 0 everywhere"))
        if (share := self._share("facing away")) > 0.05:
            text = f"nov: {share:.1%} of the pixels face away from the camera; expected none"
            lines.append(("warning", f"{text}: camera, its unit or the normals do not fit"))
        if (share := self._share("off the frame")) > 0.5:
            lines.append(("warning", f"motion: {share:.1%} of the pixels move by more than the frame, or non-finite"))
        if self._most.get("motion") == 0:
            if (shift := self._most.get("shift", 0)) > STILL:
                text = f"motion: 0 everywhere, though an object moves by {shift:.1f} pixels"
                lines.append(("warning", f"{text}; {hint}" if hint else text))
            else:
                text = "motion: 0 everywhere; expected only where neither camera nor objects move"
                lines.append(("note", f"{text}; else {hint}" if hint else text))
        return lines + self._stencil_lines()

    def _leave_out_gbuffer_frames(self, sequence: Sequence) -> None:
        """Forget the colours that no run takes if all are black: such frames were rendered for their G-buffer alone."""
        rendered = choose_rendered(sequence.numbers, sequence.rendered, None) if sequence.rendered else frozenset[int]()
        if not any(light for n, light in self._light.items() if n not in rendered):
            self._light = {n: light for n, light in self._light.items() if n in rendered}

    def _black_lines(self) -> list[Line]:
        lines: list[Line] = []
        if self._counts["hit"] and self._black:
            lines.append(("warning", f"{_black(self._black)}, in which nothing was hit, unlike in others: not rendered?"))
        if unlit := self._unlit():
            lines.append(("warning", f"{_black(unlit)}, though surfaces are seen, unlike in frames beside: not rendered?"))
        return lines

    def _unlit(self) -> list[int]:
        """The frames whose colours are all 0, where those before and after, or one beside, have at least half of the usual light.

        At the end of a fade the frame beside has little.
        """
        numbers, light = np.array(sorted(self._light)), np.array([self._light[n] for n in sorted(self._light)])
        lit, black = numbers[light > 0], numbers[light == 0]
        if not (lit.size and black.size):
            return []
        usual = light[light > 0] >= np.median(light[light > 0]) / 2
        at = np.searchsorted(lit, black)
        before, after = np.maximum(at - 1, 0), np.minimum(at, lit.size - 1)
        since, until = (at > 0) & usual[before], (at < lit.size) & usual[after]
        beside = (since & (black - lit[before] <= NEIGHBOURS)) | (until & (lit[after] - black <= NEIGHBOURS))
        return [int(n) for n in black[(since & until) | beside]]

    def _merged_lines(self, sequence: Sequence) -> list[Line]:
        source = next((f.sources["stencil"] for f in sequence.frames.values() if "stencil" in f.sources), None)
        if source is None:
            return []
        kind = read_header(source.path).formats[source.names[0]]
        limit, most = WHOLE_HALF if kind == "half" else WHOLE, self._most.get("stencil", 0)
        if most < limit or kind == "uint32":  # such a file's numbers are refused if they do not fit
            return []
        return [("warning", f"stencil: up to {most:.0f}, stored as {kind}, in which numbers above {limit} run together")]

    def _stencil_lines(self) -> list[Line]:
        faults = (
            (
                "new objects",
                "moving",
                0.5,
                "have a number that the previous frame lacks; expected objects to keep their numbers",
            ),
            ("negative stencils", "pixels", 0.0, "are negative; expected 0 for static geometry, numbers above 0 for objects"),
            ("fractional stencils", "pixels", 0.0, "are not whole numbers; expected no filtering"),
        )
        for key, of, most, words in faults:
            if (share := self._share(key, of)) > most:
                return [("warning", f"stencil: {share:.1%} of the {'moving ' if of == 'moving' else ''}pixels {words}")]
        if len(self._stencils) == 1:
            value = self._stencils.copy().pop()
            if value == 0:
                return [("note", "stencil: 0 everywhere, so everything counts as static")]
            return [("warning", f"stencil: {value:g} everywhere, so everything counts as moving; expected 0 for static")]
        if self._stencils and 0 not in self._stencils:
            return [("warning", "stencil: 0 nowhere, so everything counts as moving; expected 0 for static geometry")]
        return []

    def _position_lines(self, sequence: Sequence) -> list[Line]:
        source = next((f.sources["position"] for f in sequence.frames.values() if "position" in f.sources), None)
        if source is None or "position" not in self._most:
            return []
        unit, half = sequence.profile.units_per_cm, read_header(source.path).formats[source.names[0]] == "half"
        step = float(np.spacing(np.float32(self._most["position"] * unit))) * (2**13 if half else 1) / unit
        footprint = float(np.median(self._footprints)) if self._footprints else 0.0
        merges = half and self._most["position"] > 0  # by its steps, which the line below gives
        if self._footprints and footprint == 0 and not merges:
            return [("warning", "position: the same at neighbouring pixels; expected the place of each")]
        coarse = step > FINE * footprint
        if not half and not coarse:
            return []
        level: Level = "warning" if coarse else "note"
        precision = "half" if half else "single"
        return [
            (level, f"position: {precision} precision, in steps of {step:.2g} cm; a pixel covers {footprint:.2g} cm of a surface")
        ]

    def color_lines(self, *, linear: bool) -> list[Line]:
        """Findings about colours, which the profile says are ``linear`` or display-referred."""
        if "color" not in self._most:
            return []
        most, domain = self._most["color"], "linear" if linear else "display"
        lines: list[Line] = [("note", f"colour: largest value {most:.4g}, {domain}")]
        if not linear and most > 1:
            lines.append(("warning", f"colour: up to {most:.4g}; expected at most 1 of display-referred values"))
        if share := self._share("negative colours", "colour values"):
            lines.append(("warning" if share > 0.01 else "note", f"colour: {share:.2%} of the values negative; clipped to 0"))
        if most <= 0:
            lines.append(("warning", "colour: nothing above 0 anywhere"))
        elif most > LARGEST:
            lines.append(
                ("warning", f"colour: up to {most:.4g}, beyond {LARGEST:g}, which outputs hold at most: clamp fireflies")
            )
        elif linear and (share := self._share("lit above 1", "lit values")) > OVEREXPOSED:
            text = f"colour: {share:.0%} of the surfaces' values above 1, which the network sees as 1 and does not sharpen"
            lines.append(("warning", f"{text}: lower the exposure"))
        return lines
