"""Tile sizes: rows are checked when read, stored rows come back, and no wrong or slower row is stored."""

import io
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from stss_cl.device import tuning
from stss_cl.device.tuning import (
    OUTPUTS,
    Direct,
    Local,
    Tuning,
    Winograd,
    built_in,
    built_in_rows,
    read_tuning,
    store,
    stored_path,
    tuning_for,
)
from stss_cl.network.tiles import whole
from stss_ground.errors import DeviceError
from stss_lab.tune import tile_timing as trials
from stss_lab.tune import tune
from stss_lab.tune.tile_timing import INTEL, SHAPES, Trials, direct_candidates, winograd_candidates
from tests.tiers import thorough


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    tuning.stored_row.cache_clear()
    yield
    tuning.stored_row.cache_clear()


def fake(name="P: one", *, is_cpu=True, driver="1", target=""):
    device_class = "cpu" if is_cpu else "gpu"
    return SimpleNamespace(
        name=name, driver=driver, device_class=device_class, is_cpu=is_cpu, maker="", max_work_group=64, target=target
    )


ROW = Tuning(
    winograd={24: Winograd(4, 2, 1), 32: Winograd(1, 1, 4), 64: Winograd(6, 3, 4, vector=16)},
    direct={24: Direct(1, 3, 8), 32: Direct(4, 1, 1), 64: Direct(2, 2, 64)},
)


def test_a_row_has_what_it_does_not_say_from_its_class(tmp_path):
    path, text = tmp_path / "tuning.toml", tuning.BUILT_IN.read_text()
    rows = built_in_rows(tuning.BUILT_IN)
    gpu, nvidia, amd = (rows.classes[name] for name in ("gpu", "nvidia", "amd"))
    assert amd == gpu
    assert nvidia == replace(gpu, local=nvidia.local) != gpu
    cpu, wide = rows.classes["cpu"], rows.targets["rocketlake"]
    assert wide == replace(cpu, winograd=wide.winograd) != cpu
    assert rows.classes["gpu"].winograd is None
    assert all(tuple(row.direct) == OUTPUTS for row in rows.classes.values())
    path.write_text(text.replace("[nvidia]", "[nvidia]\nrows = 2"))
    with pytest.raises(DeviceError, match=r"nvidia\.rows: unknown key"):
        built_in_rows(path)


def test_a_processor_with_vectors_of_16_is_known_by_its_target():
    wide = built_in(fake(target="rocketlake"))
    assert {row.vector for row in wide.winograd.values()} == {16}
    for other in (fake(), fake(target="znver3"), fake(is_cpu=False, target="rocketlake")):
        assert not other.is_cpu or {row.vector for row in built_in(other).winograd.values()} == {8}
    assert built_in(fake(is_cpu=False, target="rocketlake")) == built_in(fake(is_cpu=False))


@pytest.mark.parametrize("row", [ROW, replace(ROW, winograd=None)])
def test_what_is_kept_comes_back(row, monkeypatch):
    device = fake('P: a "name" with \\ and é')
    before = tuning_for(device)
    assert read_tuning(device) is None
    store(device, row)
    assert read_tuning(device) == row == tuning_for(device)
    for other in (fake("P: two"), fake(device.name, driver="2")):
        assert tuning_for(other) == built_in(other)
    with monkeypatch.context() as patch:
        patch.setattr(tuning, "kernel_sources", lambda: ("changed",))
        tuning.stored_row.cache_clear()
        assert read_tuning(device) is None
    store(device, None)
    assert tuning_for(device) == before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("tiles = 4, tiles_held = 2", "tiles = 4, tiles_held = 3", r"winograd\.24\.tiles_held: expected a divisor of 4, found 3"),
        ("vector = 8", "vector = 8, lanes = 8", r"winograd\.24\.lanes: unknown key"),
        ("[direct]", "[strip]", r"direct: expected a table, found nothing"),
        ('"P: one"', '"P: two"', r"device: expected 'P: one', found 'P: two'"),
        ("[direct]", "[direct", "cannot be read as TOML"),
    ],
)
def test_a_wrong_row_is_named(old, new, message):
    path = store(fake(), ROW)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DeviceError, match=f"tuning {path}: {message}") as error:
        tuning_for(fake())
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("is_cpu", [True, False])
@pytest.mark.parametrize("outputs", OUTPUTS)
def test_every_candidate_could_be_kept(outputs, is_cpu):
    device = fake(is_cpu=is_cpu)
    assert [{c.vector for c in winograd_candidates(fake(name), outputs)} for name in ("P: one", f"{INTEL} one")] == [{8, 16}, {8}]
    assert all(sizes.group <= device.max_work_group for sizes in direct_candidates(device, outputs))
    for sizes in [*direct_candidates(device, outputs), *winograd_candidates(device, outputs)]:
        key = "winograd" if isinstance(sizes, Winograd) else "direct"
        row = replace(ROW, **{key: {**getattr(ROW, key), outputs: sizes}})
        store(device, row)
        assert read_tuning(device) == row


def shape_like(outputs, stride, gated):
    return next(s for s in SHAPES if (s.outputs, s.stride, s.gated) == (outputs, stride, gated))


@pytest.mark.parametrize("shape", [shape_like(24, 1, True), thorough(shape_like(24, 2, False))], ids=str)
def test_what_departs_from_the_plain_kernel_is_refused(device, shape, monkeypatch):
    """Rows left out by one candidate, one wrong bias by another: neither has a time; the others do."""
    short, wrong, good = Direct(2, shape.outputs // 8, 1), Direct(4, 1, 1), Direct(2, 1, 1)
    real = trials.conv

    def faulty(device, spec, *args, **kwargs):
        sizes = tuning_for(device).direct.get(shape.outputs)
        if sizes == wrong:
            bias = spec.packed.bias.copy()
            bias[-1] += 0.01
            spec = replace(spec, packed=replace(spec.packed, bias=bias))
        launch = real(device, spec, *args, **kwargs)
        if sizes == short:
            launch.set(count=whole(device, launch.tiling.rows - 1, launch.tiling.columns).count)
        return launch

    monkeypatch.setattr(trials, "conv", faulty)
    timings = Trials()
    fast = [built_in(device).winograd[shape.outputs]] if shape.stride == 1 and built_in(device).winograd else []
    timings.time(device, shape, (32, 64), [short, wrong, good, *fast], 1)
    assert set(timings.times[shape]) == {good, *fast}
    assert set(timings.refused) == {(shape.outputs, short), (shape.outputs, wrong)}
    assert timings.total(short, [shape]) == np.inf
    assert 0 < timings.total(good, [shape]) < np.inf


def timed(monkeypatch, seconds):
    """Have ``seconds(sizes, shape)`` in place of a measurement."""

    def time(self, device, shape, size, candidates, rounds):
        self.times[shape] = {sizes: seconds(sizes, shape) for sizes in candidates}

    monkeypatch.setattr(Trials, "time", time)


@pytest.mark.parametrize(("seconds", "winner"), [(0.97, True), (0.985, False)])
def test_the_built_in_stays_unless_beaten_by_two_per_cent(monkeypatch, seconds, winner):
    device, want = fake(), built_in(fake())
    quick = next(sizes for sizes in winograd_candidates(device, 24) if sizes != want.winograd[24])
    timed(monkeypatch, lambda sizes, _: seconds if sizes == quick else 1.0)
    assert tune.tune(device, (8, 8))[0] == (replace(want, winograd={**want.winograd, 24: quick}) if winner else want)


def test_direct_sizes_may_not_lose_elsewhere(monkeypatch):
    """Less than half of the direct convolutions have stride 2; float32-direct uses the sizes for all of them."""
    device, want = fake(), built_in(fake())
    quick = next(sizes for sizes in direct_candidates(device, 24) if sizes != want.direct[24])
    timed(monkeypatch, lambda sizes, shape: (0.5 if shape.stride == 2 else 1.5) if sizes == quick else 1.0)
    assert tune.tune(device, (8, 8))[0] == want


@pytest.mark.parametrize(("seconds", "rows"), [((0.5, 1.0), 1), ((1.0, 0.5), 2), ((1.5, 1.5), None)])
def test_rows_of_pixels_are_taken_where_they_are_faster(monkeypatch, seconds, rows):
    device = fake(is_cpu=False)
    timed(
        monkeypatch, lambda sizes, _: seconds[sizes.rows - 1] if isinstance(sizes, Local) else 1.0 + isinstance(sizes, Winograd)
    )
    local = tune.tune(device, (8, 8))[0].local
    assert (local and local.rows) == rows


def run(device, monkeypatch):
    monkeypatch.setattr(tune, "choose", lambda name, tell: device)
    out, log = (Console(file=io.StringIO(), width=200, force_terminal=terminal) for terminal in (False, True))
    tune.run(None, (32, 32), console=out, log=log)
    return out.file.getvalue(), log.file.getvalue()


@pytest.mark.thorough
def test_the_command_on_a_device(device, monkeypatch):
    """A few shapes with few candidates, for real: whatever it finds can be read and run."""
    monkeypatch.setattr(tune, "SHAPES", [shape_like(n, 1, False) for n in OUTPUTS] + [shape_like(24, 2, True)])
    for kind, of in ((direct_candidates, "direct_candidates"), (winograd_candidates, "winograd_candidates")):
        monkeypatch.setattr(tune, of, lambda device, outputs, kind=kind: kind(device, outputs)[:1])
    out, log = run(device, monkeypatch)
    assert "winograd 24" in out
    assert "4/4" in log
    assert (read_tuning(device) is not None) == ("stored: " in out)


def test_a_wrong_row_is_replaced(device, monkeypatch):
    monkeypatch.setenv("STSS_DEVICE_CLASS", device.device_class)  # the command opens the device by itself
    path = stored_path(device)
    path.write_text("nonsense")
    timed(monkeypatch, lambda sizes, _: 1.0)
    out, log = run(device, monkeypatch)
    assert "the built-in row stays" in out
    assert "removed" in log
    assert str(path) in log
    assert tuning_for(device) == built_in(device)
