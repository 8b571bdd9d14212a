# SPDX-License-Identifier: MIT
"""Read and write weights as files in the project's own format, and identify weights.

The format is safetensors with the authors' 92 names (spec 10) and the metadata of `conformance.protocol.weights_format`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from safetensors import SafetensorError, safe_open

from conformance.protocol.weights_format import CHOICES, format_metadata, take_format
from stss_ground.arguments import path_of, suggest
from stss_ground.errors import InputError
from stss_ground.output.write_whole import write_named
from stss_ground.regular_file import require_regular
from stss_ref.weights import TENSORS, Weights, WeightsError, check, require_names, require_shape, zeros

BILINEAR = "bilinear"
"""Name of the method without a network: `zeros`."""
REALTIME, ANTIALIASED = "realtime", "antialiased"
"""Names of the weights that come with the program (docs/model-card.md): for frames with one sample a pixel, and for antialiased ones."""
SHIPPED = {name: Path(__file__).with_name(f"{name}.safetensors") for name in (REALTIME, ANTIALIASED)}
"""Name -> file."""
MADE_FOR, ALIASED = "made_for", "aliased"
"""A metadata entry of weights for frames with one sample a pixel. It changes no number of stage ``frame``, so the format's version does not
know it."""
MAX_BYTES = 64 * 2**20


@dataclass(frozen=True)
class LoadedWeights:
    """Weights and where they come from.

    Attributes:
        weights: the 92 tensors, checked, and the choices of their training: second colour, hole test, hole fill.
        source: file or name, as it was given.
        identity: `identity` of the weights.
        metadata: the file's metadata, without the format's version and these three.
    """

    weights: Weights = field(repr=False)
    source: str
    identity: str
    metadata: Mapping[str, str]

    @property
    def made_for_aliased(self) -> bool:
        """Whether the file says that the weights are for frames with one sample a pixel, whose images flicker."""
        return self.metadata.get(MADE_FOR) == ALIASED

    @property
    def label(self) -> str:
        """The label in the metadata of outputs: the identity, and before it the name of weights that have one."""
        return f"{self.source} {self.identity}" if self.source in (*SHIPPED, BILINEAR) else self.identity


def identity(weights: Weights) -> str:
    """SHA-256 of names, shapes and numbers, and of settings other than the defaults: equal for equal weights in any file."""
    digest = hashlib.sha256()
    for name in reversed(CHOICES):
        if (choice := getattr(weights, name)) != CHOICES[name][0]:
            digest.update(f"{name} {choice}\n".encode())
    for name in sorted(weights):
        digest.update(f"{name} {weights[name].shape}\n".encode())
        digest.update(weights[name].astype("<f4").tobytes())
    return digest.hexdigest()


def load(source: str | Path) -> LoadedWeights:
    """Load weights from a ``.safetensors`` file, or by the names ``realtime``, ``antialiased`` and ``bilinear``.

    Args:
        source: the path or the name.

    Returns:
        The 92 tensors, read-only float32, with their name, checksum and metadata.

    Raises:
        InputError: the file cannot be read or has another format.
        WeightsError: a tensor does not fit the network.
    """
    path = path_of("weights", source)
    if str(source) == BILINEAR:
        weights, metadata = zeros(), dict[str, str]()
    else:
        path = SHIPPED.get(str(source)) or path
        _require_file(path)
        weights, metadata = _read(path)
    return LoadedWeights(weights, str(source), identity(weights), metadata)


def _require_file(path: Path) -> None:
    if path.suffix.lower() in {".pkl", ".pth", ".pt"}:
        raise InputError(f"{path}: a PyTorch checkpoint; convert it first: stss weights import")
    if path.suffix.lower() != ".safetensors":
        names = (*SHIPPED, BILINEAR)
        raise InputError(f"{path}: expected weights, a .safetensors file or one of {', '.join(names)}{suggest(str(path), names)}")
    try:
        size = require_regular(path)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    if size > MAX_BYTES:
        raise InputError(f"{path}: larger than {MAX_BYTES >> 20} MiB, so not weights of this network")


def _read(path: Path) -> tuple[Weights, dict[str, str]]:
    try:
        with safe_open(path, "numpy") as file:
            metadata = dict(file.metadata() or {})
            try:
                choices = take_format(metadata)
            except WeightsError as error:
                raise InputError(f"{path}: {error}") from error
            return check(replace(choices, tensors=_tensors(file))), metadata
    except SafetensorError as error:
        raise InputError(f"{path}: damaged safetensors file ({error})") from error
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from error


def _tensors(file: Any) -> dict[str, np.ndarray[Any, Any]]:
    # Shapes and types first: NumPy has no bfloat16, for one.
    require_names(cast("list[str]", file.keys()))
    for name in TENSORS:
        description = file.get_slice(name)
        require_shape(name, tuple(description.get_shape()))
        if description.get_dtype() != "F32":
            raise WeightsError(f"{name}: expected dtype F32, got {description.get_dtype()}")
    return {name: file.get_tensor(name) for name in TENSORS}


def save(path: str | Path, weights: Weights, metadata: Mapping[str, str]) -> None:
    """Write ``weights`` so that ``path`` is either as before or complete; equal arguments give equal bytes.

    Args:
        path: the file, ``.safetensors``.
        weights: checked before anything is written.
        metadata: their origin; the format's version, and settings other than the defaults, are added.

    Raises:
        InputError: the file can't be written.
        WeightsError: ``weights`` are not of this network.
    """
    checked = check(weights)
    write_named(Path(path), _serialise(checked, {**metadata, **format_metadata(checked)}))


def _serialise(weights: Weights, metadata: Mapping[str, str]) -> bytes:
    # Not safetensors.numpy.save: it writes the metadata in a different order each time.
    header: dict[str, Any] = {"__metadata__": dict(sorted(metadata.items()))}
    numbers = [weights[name].astype("<f4").tobytes() for name in weights]
    end = 0
    for name, data in zip(weights, numbers, strict=True):
        start, end = end, end + len(data)
        header[name] = {"dtype": "F32", "shape": list(weights[name].shape), "data_offsets": [start, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + b"".join(numbers)
