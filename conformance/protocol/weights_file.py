# SPDX-License-Identifier: MIT
"""The weights file of a job: safetensors, whose tensors, entries and metadata may stand in any order.

The library writes one order only, on which a port might rely; ports must go by the names. Nor may a port recognise a file by its header,
so nearly equal weights share theirs.
"""

from __future__ import annotations

import json
from typing import Any
from zlib import crc32

import numpy as np

from conformance.protocol.weights_format import VERSIONS, FileWeights, format_metadata, versions_of
from stss_ref.weights import Weights, check

FURTHER = {"trained": '[{"crop": "{\\"side\\": 64}"}, "weights", "paper, detail, reshade"] J\u00f6rg, 27" }, C:\\\\films\\\\'}
"""An entry of the metadata that no port needs, as in files of trained weights. It has words that elsewhere would be settings, a quote and a
bracket without their partners, a letter of two bytes, and ends with a backslash."""
ALIGNED = 8
"""The header's length is a multiple of this, as the library's is, so that the numbers are aligned."""
DRAWN_FROM = "latentEncoder.2.weight"
"""The tensor that decides the layout of a file: weights that differ in another tensor have the same header, as files of one trainer do, and
those that differ in their metadata the same numbers behind it."""
VERSION_FROM = "KEncoder.4.weight"
"""The tensor that decides, with the choices, the version of a file: another one in each kind of drawn weights."""
MORE = 0, 0, 1, 700
"""Choices for the number of surplus spaces at the header's end, in units of the alignment."""


def serialise(weights: Weights) -> bytes:
    """The bytes of a file; the same numbers and metadata give the same ones.

    Raises:
        WeightsError: weights are not of this network, or not float32.
    """
    tensors = {name: tensor.astype("<f4", copy=False).tobytes() for name, tensor in check(weights).items()}
    rng = _generator(weights)
    offsets, begin = {}, 0
    names = [str(name) for name in rng.permutation([*tensors])]
    for name in names:
        offsets[name] = begin, begin + len(tensors[name])
        begin += len(tensors[name])
    metadata = _in_any_order(rng, {**format_metadata(weights), **(FURTHER if rng.random() < 0.5 else {})})
    entries: list[tuple[str, Any]] = []
    for name in rng.permutation([*tensors]):
        entry = {"dtype": "F32", "shape": [*weights[str(name)].shape], "data_offsets": [*offsets[str(name)]]}
        entries.append((str(name), _in_any_order(rng, entry)))
    entries.insert(int(rng.choice([0, len(entries), len(entries) // 2])), ("__metadata__", metadata))
    compact = bool(rng.random() < 0.5)
    header = json.dumps(dict(entries), separators=(",", ":") if compact else (", ", ": "), ensure_ascii=compact).encode()
    header += b" " * (-len(header) % ALIGNED + ALIGNED * int(rng.choice(MORE)))
    return len(header).to_bytes(8, "little") + header + b"".join(tensors[name] for name in names)


def shuffle(weights: Weights, latest: int = min(VERSIONS)) -> Weights:
    """The same weights with the names in another order, for a port that gets them by name, and a file of any version up to ``latest``."""
    choices = weights.second_color, weights.hole_test, weights.hole_fill
    first, *others = versions_of(weights)
    version = _generator(weights, VERSION_FROM, *choices).choice([first, *(each for each in others if each <= latest)])
    return FileWeights(_in_any_order(_generator(weights), dict(weights)), *choices, int(version))


def _generator(weights: Weights, name: str = DRAWN_FROM, *words: str) -> np.random.Generator:
    return np.random.default_rng(crc32(" ".join(words).encode(), crc32(np.ascontiguousarray(weights[name]).data)))


def _in_any_order(rng: np.random.Generator, entries: dict[str, Any]) -> dict[str, Any]:
    return {str(name): entries[str(name)] for name in rng.permutation([*entries])}
