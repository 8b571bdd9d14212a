# SPDX-License-Identifier: MIT
"""Tile sizes: ``tuning.toml`` has a row for each class of device, and ``stss tune`` stores rows for single devices."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from stss_cl.device.caches import private
from stss_cl.device.discovery import CLASSES, MAKERS, DeviceClass, Properties
from stss_cl.device.grid import ceil_div
from stss_cl.device.program import source
from stss_ground.errors import DeviceError
from stss_ground.toml_table import Table, read_toml

BUILT_IN = Path(__file__).with_name("tuning.toml")
OUTPUTS = (24, 32, 64)
"""Output channels of the network's layers: a row has tile sizes for each."""
TILE = 4
"""Pixels of a row in a tile of conv.cl; a work-item's pixels divide it."""
VECTORS = (8, 16)
"""Lanes that winograd.cl computes with."""
MOST_TILES, MOST_HELD, MOST_GROUP, MOST_ROWS = 32, 16, 1024, 2


@dataclass(frozen=True)
class Winograd:
    """winograd.cl: tiles of one work-item, tiles (a divisor) and vectors of outputs held at once, lanes of a vector, of ``VECTORS``."""

    tiles: int
    tiles_held: int
    vectors_held: int
    vector: int = 8


@dataclass(frozen=True)
class Direct:
    """conv.cl: pixels and float8 of outputs held at once by one work-item; the work-group along x."""

    pixels: int
    eights_held: int
    group: int


@dataclass(frozen=True)
class Local:
    """conv_local.cl and conv_mma.cl: most rows of pixels of a work-item, 1 or 2; whether half may run on matrix units."""

    rows: int
    matrix_units: bool = False


@dataclass(frozen=True)
class Tuning:
    """One row of tile sizes.

    Attributes:
        winograd: number of output channels, of ``OUTPUTS`` -> sizes; None if another convolution is faster.
        direct: likewise, for the plain convolution.
        local: None if work-items do not share local memory, or if the direct convolution is faster.
    """

    winograd: dict[int, Winograd] | None
    direct: dict[int, Direct]
    local: Local | None = None

    def winograd_for(self, outputs: int) -> Winograd:
        """The sizes for ``outputs``, 64 at most: of the next larger number, with a divisor of the vectors held at once."""
        assert self.winograd is not None
        row = self.winograd[min(n for n in OUTPUTS if n >= outputs)]
        return replace(row, vectors_held=_most_held(row.vectors_held, ceil_div(outputs, row.vector)))

    def direct_for(self, outputs: int) -> Direct:
        """Likewise, for the plain convolution."""
        row = self.direct[min(n for n in OUTPUTS if n >= outputs)]
        return replace(row, eights_held=_most_held(row.eights_held, outputs // 8))


def _most_held(most: int, blocks: int) -> int:
    return max(n for n in range(1, most + 1) if blocks % n == 0)


_trial: ContextVar[Tuning | None] = ContextVar("_trial", default=None)


def tuning_for(device: Properties) -> Tuning:
    """The row in use: the one of ``trial``, or else the one stored for this device, or else the built-in one.

    Raises:
        DeviceError: the stored row is wrong; the message names file and key.
    """
    return _trial.get() or read_tuning(device) or built_in(device)


def built_in(device: Properties) -> Tuning:
    """The most specific row of ``tuning.toml``: for its maker's GPUs, its compiler's target, or its class."""
    return _built_in(device.maker, device.device_class, device.target)


class Rows(NamedTuple):
    """The rows of a file such as ``tuning.toml``.

    ``classes``: by class or maker, ``cpu``, ``gpu``, ``nvidia``, ...; ``targets``: by LLVM's name of the processor that kernels are
    compiled for.
    """

    classes: dict[str, Tuning]
    targets: dict[str, Tuning]


def built_in_rows(path: Path) -> Rows:
    """Read the rows of a file.

    Raises:
        DeviceError: a row is wrong; the message names file and key.
    """
    table = _read(path)
    classes = {key: _tuning(table.table(key)) for key in CLASSES}
    classes |= {key: _tuning(table.table(key, optional=True), classes["gpu"]) for key in MAKERS}
    wide = table.table("cpu-wide")
    names = wide.take("targets", "a list of names", list)
    if not all(isinstance(name, str) for name in names):
        raise wide.fail("targets", "a list of names", names)
    targets = dict.fromkeys(names, _tuning(wide, classes["cpu"]))
    table.end()
    return Rows(classes, targets)


def read_tuning(device: Properties) -> Tuning | None:
    """The row that ``store`` wrote; None if there is none for this driver and these kernels.

    Raises:
        DeviceError: it is wrong.
    """
    return stored_row(device.name, device.driver, device.device_class)


def store(device: Properties, tuning: Tuning | None) -> Path:
    """Store a row for this device, for every later process; None: go back to the built-in row. Returns the file."""
    path = stored_path(device)
    if tuning is None:
        path.unlink(missing_ok=True)
    else:
        text = "# By `stss tune`; without this file the built-in row counts.\n"
        for key, value in (("device", device.name), ("driver", device.driver)):
            text += f"{key} = {json.dumps(value, ensure_ascii=False)}\n"
        beside = path.with_suffix(f".{os.getpid()}")
        beside.write_text(text + to_toml(tuning), encoding="utf-8")
        beside.replace(path)
    stored_row.cache_clear()
    return path


def stored_path(device: Properties) -> Path:
    """The file in which this device's row is stored; it may not exist."""
    return _path(device.name, device.driver, device.device_class)


def to_toml(tuning: Tuning) -> str:
    """A row as the text of a file."""
    lines = [] if tuning.local is None else ["", f"local = {_inline(tuning.local)}"]
    for key, rows in (("winograd", tuning.winograd), ("direct", tuning.direct)):
        if rows is not None:
            lines += ["", f"[{key}]", *(f"{outputs} = {_inline(row)}" for outputs, row in rows.items())]
    return "\n".join(lines[1:]) + "\n"


@contextmanager
def trial(tuning: Tuning) -> Generator[None]:
    """Within the block, and in this thread, every device uses the row ``tuning``."""
    token = _trial.set(tuning)
    try:
        yield
    finally:
        _trial.reset(token)


def _inline(row: Winograd | Direct | Local) -> str:
    return "{ " + ", ".join(f"{key} = {json.dumps(value)}" for key, value in asdict(row).items()) + " }"


@lru_cache(64)
def _built_in(maker: str, device_class: DeviceClass, target: str) -> Tuning:
    rows = built_in_rows(BUILT_IN)
    general = rows.classes[maker or device_class]
    return rows.targets.get(target, general) if device_class == "cpu" else general


@lru_cache(64)
def stored_row(name: str, driver: str, device_class: DeviceClass) -> Tuning | None:
    """The stored row for a device; None: there is none."""
    path = _path(name, driver, device_class)
    if not path.exists():
        return None
    table = _read(path)
    for key, expected in (("device", name), ("driver", driver)):
        if table.rest.get(key) != expected:
            raise table.fail(key, repr(expected), table.rest.get(key))
        del table.rest[key]
    return _tuning(table)


def _path(name: str, driver: str, device_class: DeviceClass) -> Path:
    # A row that was found with other kernels may be slower with these.
    what = [name, driver, device_class, *kernel_sources()]
    return private("tuning") / f"{hashlib.sha256(json.dumps(what).encode()).hexdigest()[:32]}.toml"


@lru_cache(1)
def kernel_sources() -> tuple[str, ...]:
    """The texts of the kernels whose tile sizes a row has."""
    return tuple(source(file) for file in ("conv.cl", "winograd.cl", "winograd_image.cl", "conv_local.cl", "conv_mma.cl"))


def _tuning(table: Table, like: Tuning | None = None) -> Tuning:
    """A row, every key of it checked: a whole one, or its differences from the row ``like``."""

    def sizes(key: str) -> Table | None:
        return None if key not in table.rest and (like is not None or key == "winograd") else table.table(key)

    winograd, direct = sizes("winograd"), sizes("direct")
    other = like or Tuning(winograd=None, direct={})
    row = Tuning(
        winograd={n: _winograd(winograd.table(str(n)), n) for n in OUTPUTS} if winograd else other.winograd,
        direct={n: _direct(direct.table(str(n)), n) for n in OUTPUTS} if direct else other.direct,
        local=_local(table.table("local")) if "local" in table.rest else other.local,
    )
    for each in (table, direct, winograd):
        if each is not None:
            each.end()
    return row


def _winograd(table: Table, outputs: int) -> Winograd:
    tiles = table.whole("tiles", MOST_TILES)
    tiles_held, vector = table.whole("tiles_held", MOST_HELD, divides=tiles), table.rest.pop("vector", None)
    if type(vector) is not int or vector not in VECTORS:
        raise table.fail("vector", " or ".join(map(str, VECTORS)), vector)
    if vector > 8 and tiles % 2:
        raise table.fail("tiles", f"an even number where vectors have {vector} lanes", tiles)
    blocks = ceil_div(outputs, vector)
    row = Winograd(tiles, tiles_held, table.whole("vectors_held", blocks, divides=blocks), vector)
    table.end()
    return row


def _direct(table: Table, outputs: int) -> Direct:
    pixels = table.whole("pixels", TILE, divides=TILE)
    eights_held = table.whole("eights_held", outputs // 8, divides=outputs // 8)
    row = Direct(pixels, eights_held, table.whole("group", MOST_GROUP))
    table.end()
    return row


def _local(table: Table) -> Local:
    row = Local(table.whole("rows", MOST_ROWS), table.flag("matrix_units"))
    table.end()
    return row


def _read(path: Path) -> Table:
    return read_toml(path, lambda message: DeviceError(f"tuning {message}"))
