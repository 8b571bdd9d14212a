# SPDX-License-Identifier: MIT
"""The shards of a data folder: list their samples, and draw batches."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Literal

import numpy as np

from stss_ground.errors import InputError
from stss_ref.arrays import Array
from training.augment import MASK, Batch, augment, collate, crop, mask_at_random

Kind = Literal["SF", "EF"]
KINDS: tuple[Kind, Kind] = ("SF", "EF")

DRAWN = 3
"""Crops drawn for each crop taken, which is the one with the most detail: half of an average frame is flat, and teaches little."""


@dataclass(frozen=True)
class Shard:
    """The samples of a sequence, memory-mapped; see `training.samples`."""

    name: str
    scene: str
    split: str
    kinds: tuple[str, ...]
    inputs: Array = field(repr=False)
    truth: Array = field(repr=False)


@dataclass(frozen=True)
class StoredSample:
    """A sample: its shard, and its position in the shard."""

    shard: Shard
    index: int


def load_shards(folder: Path) -> list[Shard]:
    """Every complete shard below ``folder``, sorted by name.

    Raises:
        InputError: there is no shard, or one scene is in two splits.
    """
    shards: list[Shard] = []
    for path in sorted(folder.rglob("index.json")):
        index = json.loads(path.read_text())
        inputs, truth = (np.load(path.parent / f"{name}.npy", mmap_mode="r") for name in ("inputs", "truth"))
        name = str(path.parent.relative_to(folder))
        shards.append(Shard(name, index["scene"], index["split"], tuple(index["kinds"]), inputs, truth))
    if not shards:
        raise InputError(f"{folder}: no samples; python -m training.samples makes them")
    splits: dict[str, str] = {}
    for shard in shards:
        if splits.setdefault(shard.scene, shard.split) != shard.split:
            raise InputError(f"{folder}: scene {shard.scene} is in the splits {splits[shard.scene]} and {shard.split}")
    return shards


def places(shards: list[Shard], split: str, kind: str) -> list[StoredSample]:
    """The samples of a split and a kind of frame."""
    return [StoredSample(s, i) for s in shards if s.split == split for i, k in enumerate(s.kinds) if k == kind]


def sets(choice: list[StoredSample]) -> list[list[StoredSample]]:
    """The samples grouped by the folder of their shard: training draws from each folder equally often, whatever its size."""
    found: dict[str, list[StoredSample]] = {}
    for place in choice:
        found.setdefault(str(PurePath(place.shard.name).parent), []).append(place)
    return list(found.values())


class Batches:
    """Training batches, half SF and half EF. A batch depends only on the seed and its number, so a resumed run sees the same batches.

    Ablations take other ``kinds`` than both in equal shares, or ``masking=False``, without Random Reshading Masking. ``upright``: see
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
        upright: bool = False,
    ):
        self._kinds, self._masking, self._upright = kinds, masking, upright
        self._sets = {kind: sets(places(shards, "training", kind)) for kind in KINDS}
        if not all(self._sets.values()):
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
        made: list[tuple[Array, Array, Array]] = []
        for i in range(self._batch):
            drawn = [self._draw(self._kinds[i % len(self._kinds)], random) for _ in range(DRAWN)]
            place, corner = max(drawn, key=lambda one: self._detail(*one))
            taken = crop(place.shard.inputs[place.index], place.shard.truth[place.index], corner, self._side)
            inputs, truth = augment(*taken, random, upright=self._upright)
            mask = mask_at_random(inputs, random) if self._masking else inputs[..., MASK]
            made.append((inputs, mask, truth))
        inputs, masks, truth = (np.stack(arrays) for arrays in zip(*made, strict=True))
        return collate(inputs, masks, truth)

    def _draw(self, kind: Kind, random: np.random.Generator) -> tuple[StoredSample, tuple[int, int]]:
        """Draw a sample, and the corner of a crop in it."""
        chosen = self._sets[kind][int(random.integers(len(self._sets[kind])))]
        place = chosen[int(random.integers(len(chosen)))]
        height, width = place.shard.inputs.shape[1:3]
        return place, (
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
    found = np.abs(blocks - blocks.mean(axis=(1, 3), keepdims=True)).sum(axis=(1, 3, 4), dtype=np.float64)
    return np.pad(found.cumsum(0).cumsum(1), ((1, 0), (1, 0)))


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
