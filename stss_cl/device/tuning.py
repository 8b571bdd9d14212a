# SPDX-License-Identifier: MIT
"""Tile sizes: data in ``tuning.toml``, one row per class of device, and rows that ``stss tune`` found for single devices."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

from stss_cl.device.caches import private
from stss_cl.device.discovery import DeviceClass, DeviceError, Properties
from stss_cl.device.program import source

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

BUILT_IN = Path(__file__).with_name("tuning.toml")
OUTPUTS = (24, 32, 64)
"""Output channels of the network's layers: a row has tile sizes for each."""
MOST_PIXELS = 8
"""Of conv.cl: at stride 2 a work-item then reads no further beyond a row than ``stss_cl.device.buffers.SLACK``."""
MOST_TILES, MOST_HELD, MOST_GROUP, MOST_STRIP = 32, 16, 1024, 4096


@dataclass(frozen=True)
class Winograd:
    """winograd.cl: tiles of one work-item, tiles (a divisor) and float8 of outputs held at once."""

    tiles: int
    rows: int
    block: int
    prefetch: bool = False


@dataclass(frozen=True)
class Direct:
    """conv.cl: pixels and float8 of outputs held at once by one work-item; the work-group along x."""

    pixels: int
    block: int
    group: int


@dataclass(frozen=True)
class Strip:
    """Kernels that go along a row: pixels of one work-item (a multiple of 4), work-group along x."""

    pixels: int
    group: int


@dataclass(frozen=True)
class Tuning:
    """One row. ``winograd`` is None where the direct convolution is faster; both by output channels, ``OUTPUTS``."""

    winograd: dict[int, Winograd] | None
    direct: dict[int, Direct]
    strip: Strip


_trial: ContextVar[Tuning | None] = ContextVar("_trial", default=None)


def tuning_for(device: Properties) -> Tuning:
    """The row in force: that of ``trial``, or else the one kept for this device, or else the built-in one.

    Raises:
        DeviceError: the kept row is wrong; the message names file and key.
    """
    return _trial.get() or _in_force(device.name, device.driver, device.device_class)


def built_in(device: Properties) -> Tuning:
    """The row of ``tuning.toml`` for this device or its class."""
    return _built_in(device.name, device.device_class)


def kept(device: Properties) -> Tuning | None:
    """The row that ``keep`` wrote; None: there is none for this driver and these kernels.

    Raises:
        DeviceError: it is wrong.
    """
    return _kept(device.name, device.driver, device.device_class)


def keep(device: Properties, tuning: Tuning | None) -> Path:
    """Use this row for this device from now on, in every process; None: the built-in one."""
    path = kept_path(device)
    if tuning is None:
        path.unlink(missing_ok=True)
    else:
        text = "# By `stss tune`; without this file the built-in row counts.\n"
        for key, value in (("device", device.name), ("driver", device.driver)):
            text += f"{key} = {json.dumps(value, ensure_ascii=False)}\n"
        beside = path.with_suffix(f".{os.getpid()}")
        beside.write_text(text + to_toml(tuning), encoding="utf-8")
        beside.replace(path)
    _in_force.cache_clear()
    return path


def kept_path(device: Properties) -> Path:
    """Where this device's row is kept, whether or not it is there."""
    return _path(device.name, device.driver, device.device_class)


def to_toml(tuning: Tuning) -> str:
    """A row as it stands in a file."""
    lines = [f"strip = {_inline(tuning.strip)}"]
    for key, rows in (("winograd", tuning.winograd), ("direct", tuning.direct)):
        if rows is not None:
            lines += ["", f"[{key}]", *(f"{outputs} = {_inline(row)}" for outputs, row in rows.items())]
    return "\n".join(lines) + "\n"


@contextmanager
def trial(tuning: Tuning) -> Generator[None]:
    """Within the block and this thread ``tuning`` is the row of every device."""
    token = _trial.set(tuning)
    try:
        yield
    finally:
        _trial.reset(token)


def _inline(row: Winograd | Direct | Strip) -> str:
    return "{ " + ", ".join(f"{key} = {json.dumps(value)}" for key, value in asdict(row).items()) + " }"


@lru_cache(64)
def _in_force(name: str, driver: str, device_class: DeviceClass) -> Tuning:
    return _kept(name, driver, device_class) or _built_in(name, device_class)


@lru_cache(64)
def _built_in(name: str, device_class: DeviceClass) -> Tuning:
    table = _read(BUILT_IN)
    classes = {key: _tuning(table.table(key)) for key in ("cpu", "gpu")}
    devices = table.table("device") if "device" in table.rest else _Table(BUILT_IN, "", {})
    single = {key: _tuning(devices.table(key)) for key in tuple(devices.rest)}
    table.end()
    return single.get(name, classes[device_class])


def _kept(name: str, driver: str, device_class: DeviceClass) -> Tuning | None:
    path = _path(name, driver, device_class)
    if not path.exists():
        return None
    table = _read(path)
    for key, expected in (("device", name), ("driver", driver)):
        if table.rest.get(key) != expected:
            raise table.fail(key, repr(expected))
        del table.rest[key]
    return _tuning(table)


def _path(name: str, driver: str, device_class: DeviceClass) -> Path:
    # A row found with other kernels may be the slower one with these.
    what = [name, driver, device_class, *_kernels()]
    return private("tuning") / f"{hashlib.sha256(json.dumps(what).encode()).hexdigest()[:32]}.toml"


@lru_cache(1)
def _kernels() -> tuple[str, ...]:
    return source("conv.cl"), source("winograd.cl")


def _tuning(table: _Table) -> Tuning:
    """A whole row; every key of it is checked."""
    winograd = table.table("winograd") if "winograd" in table.rest else None
    direct, strip = table.table("direct"), table.table("strip")
    found = Tuning(
        winograd={n: _winograd(winograd.table(str(n)), n) for n in OUTPUTS} if winograd else None,
        direct={n: _direct(direct.table(str(n)), n) for n in OUTPUTS},
        strip=Strip(strip.whole("pixels", MOST_STRIP, multiple=4), strip.whole("group", MOST_GROUP)),
    )
    for each in (table, direct, strip, *((winograd,) if winograd else ())):
        each.end()
    return found


def _winograd(table: _Table, outputs: int) -> Winograd:
    tiles = table.whole("tiles", MOST_TILES)
    rows = table.whole("rows", MOST_HELD, divides=tiles)
    found = Winograd(tiles, rows, table.whole("block", outputs // 8, divides=outputs // 8), table.flag("prefetch"))
    table.end()
    return found


def _direct(table: _Table, outputs: int) -> Direct:
    pixels, block = table.whole("pixels", MOST_PIXELS), table.whole("block", outputs // 8, divides=outputs // 8)
    found = Direct(pixels, block, table.whole("group", MOST_GROUP))
    table.end()
    return found


class _Table:
    """A TOML table whose keys are taken one by one; what is left over at the end is unknown."""

    def __init__(self, path: Path, prefix: str, values: dict[str, Any]):
        self.path, self.prefix, self.rest = path, prefix, dict(values)

    def fail(self, key: str, expected: str) -> DeviceError:
        found = repr(self.rest[key]) if key in self.rest else "nothing"
        return DeviceError(f"tuning {self.path}: {self.prefix}{key}: expected {expected}, found {found}")

    def table(self, key: str) -> _Table:
        if not isinstance(self.rest.get(key), dict):
            raise self.fail(key, "a table")
        return _Table(self.path, f"{self.prefix}{key}.", cast(dict[str, Any], self.rest.pop(key)))

    def whole(self, key: str, most: int, *, divides: int | None = None, multiple: int = 1) -> int:
        value = self.rest.get(key)
        if type(value) is not int or not 1 <= value <= most:
            raise self.fail(key, f"a whole number from 1 to {most}")
        if divides is not None and divides % value:
            raise self.fail(key, f"a divisor of {divides}")
        if value % multiple:
            raise self.fail(key, f"a multiple of {multiple}")
        return self.rest.pop(key)

    def flag(self, key: str) -> bool:
        if type(self.rest.get(key, False)) is not bool:
            raise self.fail(key, "true or false")
        return self.rest.pop(key, False)

    def end(self) -> None:
        for key in self.rest:
            raise DeviceError(f"tuning {self.path}: {self.prefix}{key}: unknown key")


def _read(path: Path) -> _Table:
    try:
        return _Table(path, "", tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DeviceError(f"tuning {path}: cannot be read as TOML: {' '.join(str(error).split())}") from None
