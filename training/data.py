# SPDX-License-Identifier: MIT
"""The shards of a data folder: list their samples, and draw batches."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePath
from typing import Literal

import numpy as np

from stss_ground.errors import InputError
from stss_ref.arrays import Array
from stss_ref.constants import HOLE_FILLS, HoleFill
from stss_ref.weights import Weights
from training.augment import MASK, MOTION, Augment, Batch, augment, collate, crop, mask_at_random
from training.samples import NOWHERE

Kind = Literal["SF", "EF"]
KINDS: tuple[Kind, Kind] = ("SF", "EF")

DRAWS = 3
"""Crops drawn of a folder for each crop used, which is the one with the most detail: half of an average frame is flat, and teaches
little."""


@dataclass(frozen=True)
class Shard:
    """The samples of a sequence, memory-mapped; see `training.samples`."""

    name: str
    scene: str
    split: str
    frames: tuple[int, ...]
    kinds: tuple[str, ...]
    hole_fill: HoleFill
    inputs: Array = field(repr=False)
    truth: Array = field(repr=False)


@dataclass(frozen=True)
class StoredSample:
    """A sample: its shard, and its position in the shard."""

    shard: Shard
    index: int


def load_shards(folder: Path, weights: Weights | None = None) -> list[Shard]:
    """Every complete shard below ``folder``, sorted by name, for ``weights`` that read them.

    Raises:
        InputError: there is no shard, one scene is in two splits, or holes were filled by more than one stage or by another than
            ``weights`` name.
    """
    shards: list[Shard] = []
    for path in sorted(folder.rglob("index.json")):
        index = json.loads(path.read_text())
        inputs, truth = (np.load(path.parent / f"{name}.npy", mmap_mode="r") for name in ("inputs", "truth"))
        name = str(path.parent.relative_to(folder))
        by = index.get("hole_fill", HOLE_FILLS[0])
        shards.append(
            Shard(name, index["scene"], index["split"], tuple(index["frames"]), tuple(index["kinds"]), by, inputs, truth)
        )
    if not shards:
        raise InputError(f"{folder}: no samples; python -m training.samples makes them")
    if len(fills := {shard.hole_fill for shard in shards}) > 1:
        raise InputError(f"{folder}: expected samples of one --hole-fill, found {' and '.join(sorted(fills))}")
    if weights is not None and fills != {weights.hole_fill}:
        raise InputError(
            f"{folder}: expected samples of --hole-fill {weights.hole_fill}, as the weights say; found {fills.pop()}"
        )
    splits: dict[str, str] = {}
    for shard in shards:
        if splits.setdefault(shard.scene, shard.split) != shard.split:
            raise InputError(f"{folder}: scene {shard.scene} is in the splits {splits[shard.scene]} and {shard.split}")
    return shards


def places(shards: list[Shard], split: str, kind: str) -> list[StoredSample]:
    """The samples of a split and a kind of frame."""
    return [StoredSample(s, i) for s in shards if s.split == split for i, k in enumerate(s.kinds) if k == kind]


def pairs(shards: list[Shard], split: str) -> list[tuple[StoredSample, StoredSample]]:
    """Each SF of a split with the EF of a frame beside it, as frames follow one another; else with the EF of its own frame."""
    couples: list[tuple[StoredSample, StoredSample]] = []
    for sf in places(shards, split, "SF"):
        at = sf.shard.frames[sf.index]
        efs = [StoredSample(sf.shard, i) for i, kind in enumerate(sf.shard.kinds) if kind == "EF"]
        beside = [ef for ef in efs if abs(ef.shard.frames[ef.index] - at) == 1]
        couples += [(sf, ef) for ef in beside or efs if beside or ef.shard.frames[ef.index] == at]
    return couples


def sets(choice: Sequence[tuple[StoredSample, ...]]) -> list[list[tuple[StoredSample, ...]]]:
    """The draws grouped by the folder of their shard: training draws from each folder equally often, whatever its size."""
    by_folder: dict[str, list[tuple[StoredSample, ...]]] = {}
    for draw in choice:
        by_folder.setdefault(str(PurePath(draw[0].shard.name).parent), []).append(draw)
    return list(by_folder.values())


class Batches:
    """Training batches of pairs, an SF and an EF, of consecutive frames where the shard has them.

    A batch depends only on the seed and its number, so a resumed run sees the same batches.

    ``kinds``: both in equal shares, or one alone; ``masking=False``: without Random Reshading Masking. ``how``: see
    `training.augment.augment`.
    """

    def __init__(
        self,
        shards: list[Shard],
        *,
        side: int,
        batch: int,
        seed: int,
        kinds: Sequence[Kind] = KINDS,
        masking: bool = True,
        how: Augment = "all",
    ):
        self._masking, self.augment = masking, partial(augment, how=how)
        both = pairs(shards, "training")
        self._sets = sets(both if len(kinds) > 1 else [(place,) for place in places(shards, "training", kinds[0])])
        self._together = len(kinds)
        if not both:
            raise InputError("the training split lacks SF or EF samples")
        smallest = min(min(s.inputs.shape[1:3]) for s in shards if s.split == "training")
        if side % 8 or not 8 <= side <= smallest:
            raise InputError(f"crop: expected a multiple of 8, at most the frames' {smallest}, got {side}")
        if batch < 2 or batch % 2:
            raise InputError(f"batch: expected an even number, one half SF, one half EF, got {batch}")
        self._side, self._batch, self._seed = side, batch, seed
        self._details: dict[tuple[str, int], Array] = {}

    def __getitem__(self, step: int) -> Batch:
        random = np.random.default_rng([self._seed, step])
        parts: list[tuple[Array, Array, Array]] = []
        for _ in range(self._batch // self._together):
            group = self._sets[int(random.integers(len(self._sets)))]
            draws = [self._draw(group, random) for _ in range(DRAWS)]
            together, corner = max(draws, key=lambda one: self._detail(one[0][0], one[1]))
            crops = [crop(p.shard.inputs[p.index], p.shard.truth[p.index], corner, self._side) for p in together]
            last = max(p.shard.frames[p.index] for p in together)
            for place, (inputs, _) in zip(together, crops, strict=True):
                if place.shard.frames[place.index] < last or len({p.shard.frames[p.index] for p in together}) == 1:
                    inputs[..., MOTION] = NOWHERE
            inputs, truth = (np.stack(arrays) for arrays in zip(*crops, strict=True))
            inputs, truth = self.augment(inputs, truth, random)
            masks = [mask_at_random(one, random) for one in inputs] if self._masking else inputs[..., MASK]
            parts.append((inputs, np.asarray(masks), truth))
        inputs, masks, truth = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        return collate(inputs, masks, truth)

    def _draw(
        self, group: Sequence[tuple[StoredSample, ...]], random: np.random.Generator
    ) -> tuple[tuple[StoredSample, ...], tuple[int, int]]:
        """Draw samples of a folder that belong together, and the corner of a crop in them."""
        together = group[int(random.integers(len(group)))]
        height, width = together[0].shard.inputs.shape[1:3]
        return together, (
            int(random.integers(0, height - self._side, endpoint=True)),
            int(random.integers(0, width - self._side, endpoint=True)),
        )

    def _detail(self, place: StoredSample, corner: tuple[int, int]) -> float:
        key = place.shard.name, place.index
        if key not in self._details:
            self._details[key] = details(place.shard.truth[place.index])
        (y, x), sums = corner, self._details[key]
        below, right = y + self._side, x + self._side
        return float(sums[below, right] - sums[y, right] - sums[below, x] + sums[y, x])

    def between(self, first: int, last: int, ahead: int = 4, workers: int = 1) -> Iterator[tuple[int, Batch]]:
        """Yield ``(step, batch)`` for ``first <= step < last``; threads make the batches ahead."""
        with ThreadPoolExecutor(workers) as pool:
            waiting = [pool.submit(self.__getitem__, step) for step in range(first, min(first + ahead, last))]
            for step in range(first, last):
                batch = waiting.pop(0).result()
                if step + ahead < last:
                    waiting.append(pool.submit(self.__getitem__, step + ahead))
                yield step, batch


def details(truth: Array) -> Array:
    """Detail that half the size loses, the distances of four pixels from their mean, as sums from the corner, (H + 1, W + 1)."""
    height, width, channels = truth.shape
    blocks = truth.astype(np.float32).reshape(height // 2, 2, width // 2, 2, channels)
    distances = np.abs(blocks - blocks.mean(axis=(1, 3), keepdims=True)).sum(axis=(1, 3, 4), dtype=np.float64)
    return np.pad(distances.cumsum(0).cumsum(1), ((1, 0), (1, 0)))


def whole(place: StoredSample) -> Batch:
    """A whole frame as a batch of one, with its own mask and without augmentation; padded to multiples of 8 as for the network (spec 7)."""
    inputs = place.shard.inputs[place.index].astype(np.float32)
    truth = place.shard.truth[place.index].astype(np.float32)
    below, right = (-length % 8 for length in inputs.shape[:2])
    inputs = np.pad(inputs, ((0, below), (0, right), (0, 0)), mode="edge")
    return collate(inputs[None], inputs[None, ..., MASK], truth[None])


def spread(choice: list[StoredSample], most: int) -> list[StoredSample]:
    """At most ``most`` of the samples, spread evenly over as many scenes as possible."""
    if len(choice) <= most:
        return choice
    return [choice[i * len(choice) // most] for i in range(most)]
