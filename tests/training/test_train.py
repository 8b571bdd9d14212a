"""A short run, and one that is stopped and resumed."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from stss.weights.file import ALIASED, MADE_FOR, load, save
from stss_cl.liveness import find_live
from stss_ground.errors import InputError
from stss_ref.schedule import FrameKind
from stss_ref.weights import Weights, random
from training.samples import Sample, write

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")
torch.set_num_threads(1)

from training.average import main as average  # noqa: E402
from training.data import Batches, load_shards, pairs  # noqa: E402
from training.prune import main as prune  # noqa: E402
from training.step import Aims, advance, objective  # noqa: E402
from training.train import Settings, keep, main, rate_at, start  # noqa: E402
from training.validate import main as validate  # noqa: E402
from training.validate import tensors  # noqa: E402


def run(data, out, steps, *more):
    common = ["--crop", "16", "--batch", "2", "--warm-up", "4", "--rate", "2e-2", "--device", "cpu", "--threads", "1"]
    main([str(data), "-o", str(out), "--steps", str(steps), "--validate", "4", "--log", "2", *common, *more])
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def test_a_run_beats_bilinear_and_writes_weights(data, tmp_path):
    records = run(data, tmp_path, 40)
    start, end = records[0]["bilinear"], records[-1]["validation"]
    assert abs(records[0]["initial"]["SF"] - start["SF"]) < 1  # it starts near `bilinear`
    assert end["SF"] > start["SF"] + 3
    assert end["EF"] > start["EF"] + 3
    assert load(tmp_path / "weights.safetensors").metadata["steps"] == "40"
    assert json.loads(load(tmp_path / "best.safetensors").metadata["validation"])["SF"] >= end["SF"]


def test_the_log_begins_with_the_weights_that_it_starts_from(data, tmp_path):
    """So a run that only became worse does not count as a gain."""
    run(data, tmp_path / "first", 40)
    first = run(data, tmp_path / "second", 1, "--initial", str(tmp_path / "first" / "weights.safetensors"))[0]
    last = json.loads((tmp_path / "first" / "log.jsonl").read_text().splitlines()[-1])["validation"]
    assert first["step"] == 0
    assert {name: first["initial"][name] for name in ("SF", "EF")} == pytest.approx({n: last[n] for n in ("SF", "EF")}, abs=1e-3)


def test_the_best_weights_are_never_worse_than_those_at_the_start(data, tmp_path):
    run(data, tmp_path / "first", 40)
    run(data, tmp_path / "second", 4, "--initial", str(tmp_path / "first" / "weights.safetensors"), "--rate", "9")
    first, best, last = (load(tmp_path / f"{name}.safetensors") for name in ("first/weights", "second/best", "second/weights"))
    assert best.metadata["steps"] == "0"
    assert all(np.array_equal(best.weights[name], array) for name, array in first.weights.items())
    assert last.label != best.label


@pytest.mark.parametrize("made_for", [{MADE_FOR: ALIASED}, {}])
def test_weights_are_made_for_the_frames_that_the_initial_ones_are_made_for(data, tmp_path, made_for):
    """Without the entry `stss run` does not mix images: weights of one game, trained from `realtime`, would flicker."""
    save(tmp_path / "before.safetensors", random(0), made_for)
    for steps, more in ((1, []), (2, ["--resume"])):
        run(data, tmp_path / "run", steps, "--initial", str(tmp_path / "before.safetensors"), *more)
    trained = [load(tmp_path / "run" / f"{name}.safetensors") for name in ("best", "weights")]
    assert [each.made_for_aliased for each in trained] == [bool(made_for)] * 2


def test_samples_have_the_fill_that_the_weights_name(data, tmp_path):
    """Else weights trained further would lose `reshade`, and a measurement would be of other inputs than the program's."""
    weights = tmp_path / "reshade.safetensors"
    save(weights, replace(random(0), hole_fill="reshade"), {})
    before = ["--device", "cpu", "--initial", str(weights)]
    words = {main: ["-o", str(tmp_path / "run"), *before], prune: ["-o", str(tmp_path / "p.safetensors"), "--weights", str(weights)],
             validate: ["--weights", str(weights), "--split", "validation"]}  # fmt: skip
    for program, more in words.items():
        with pytest.raises(InputError, match="expected samples of --hole-fill reshade, as the weights say; found occlusion_warp"):
            program([str(data), *more])
    assert [path.name for path in tmp_path.iterdir()] == ["reshade.safetensors"]


def test_a_resumed_run_is_the_same_run(data, tmp_path, monkeypatch):
    whole = run(data, tmp_path / "whole", 8)

    def keep_and_die(out, state, means):
        keep(out, state, means)
        if state.step == 4:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("training.train.keep", keep_and_die)
        with pytest.raises(KeyboardInterrupt):
            run(data, tmp_path / "two", 8)
    resumed = run(data, tmp_path / "two", 8, "--resume")
    for name in ("weights.safetensors", "state.safetensors"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    assert [{k: v for k, v in r.items() if k != "ms"} for r in whole] == [
        {k: v for k, v in r.items() if k != "ms"} for r in resumed
    ]


def test_weights_of_the_other_hole_test_are_trained_and_not_validated(data, tmp_path):
    """The authors' weights had 3 dB more in EFs by other holes than those of a run of the program."""
    authors = str(tmp_path / "authors.safetensors")
    save(authors, Weights(random(0), hole_test="paper"), {})
    with pytest.raises(InputError, match="hole test footprint, as the samples have it, found paper; stss methods"):
        validate([str(data), "--weights", authors, "--split", "validation"])
    ours = str(tmp_path / "ours.safetensors")
    save(ours, Weights(random(1), hole_test="footprint"), {})
    with pytest.raises(InputError, match="expected one hole test, found footprint and paper"):
        average([authors, ours, "-o", str(tmp_path / "mean.safetensors")])
    run(data, tmp_path / "run", 4, "--initial", authors)
    validate(
        [str(data), "--weights", str(tmp_path / "run" / "weights.safetensors")]
    )  # ``test`` is read where it is asked for alone


def test_options_reach_the_run(data, tmp_path):
    """``--no-history``: weights that say so; the others: another loss, and so other weights, also other than each other's."""
    run(data, tmp_path / "start", 4)
    start = ("--initial", str(tmp_path / "start" / "weights.safetensors"))
    squares = ("--squares", "0.9")
    runs = {
        "plain": (),
        "squares": squares,
        "structure": ("--structure", "90"),
        "structure of EFs": ("--structure", "90", "--structure-ef", "20"),
        "extrapolated": (*squares, "--extrapolated", "0.7"),
        "upright": ("--augment", "upright"),
        "one scene": ("--augment", "none"),
        "detail": ("--second-color", "detail"),
    }
    for name, options in runs.items():
        run(data, tmp_path / name, 4, *start, *options)
    run(data, tmp_path / "no history", 4, "--no-history")
    detailed = tmp_path / "detail" / "weights.safetensors"
    run(data, tmp_path / "on", 4, "--initial", str(detailed))
    run(data, tmp_path / "back", 4, "--initial", str(detailed), "--second-color", "newest")
    weights_of = {name: load(tmp_path / name / "weights.safetensors") for name in (*runs, "no history", "on", "back")}
    assert [name for name, loaded in weights_of.items() if loaded.weights.second_color == "detail"] == ["detail", "on"]
    with pytest.raises(InputError, match="weights: expected one second colour, found detail and newest"):
        average([str(detailed), str(tmp_path / "back" / "weights.safetensors"), "-o", str(tmp_path / "mean.safetensors")])
    average([str(detailed), str(detailed), "-o", str(tmp_path / "mean.safetensors")])
    assert load(tmp_path / "mean.safetensors").weights.second_color == "detail"
    assert [name for name, loaded in weights_of.items() if not find_live(loaded.weights).reads_history] == ["no history"]
    sums = {name: loaded.label for name, loaded in weights_of.items()}
    assert len(set(sums.values())) == len(sums)


def test_a_run_and_nothing_after_it_has_no_denormal_numbers(data, tmp_path, monkeypatch):
    """They come from dead units, and made long runs twice as slow; the judge of ports asks about them in the same process."""
    small, products = torch.tensor([1e-310], dtype=torch.float64), []
    monkeypatch.setattr("training.train.keep", lambda out, state, means: products.append((small * 0.5).item()))
    run(data, tmp_path, 4)
    assert products == [0, 0]  # at the start, and at the end
    assert (small * 0.5).item() > 0


def test_a_run_is_not_overwritten_and_not_mixed(data, tmp_path):
    run(data, tmp_path, 4)
    with pytest.raises(InputError, match="holds a run"):
        run(data, tmp_path, 4)
    with pytest.raises(InputError, match="made with seed 0, not 1"):
        run(data, tmp_path, 4, "--resume", "--seed", "1")
    folder = next(path.parent for path in data.rglob("index.json"))
    shutil.copytree(folder, tmp_path / "others" / "film")
    with pytest.raises(InputError, match=r"made with data \d+ shards, \w+, not 1 shards, \w+; resume"):
        run(tmp_path / "others", tmp_path, 4, "--resume")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU of this name")
def test_a_device_that_is_not_there_is_one_line(data, tmp_path):
    for name in ("cuda", "gpu"):
        with pytest.raises(InputError, match=f"--device {name}: .+"):
            run(data, tmp_path / "run", 4, "--device", name)
    assert not (tmp_path / "run").exists()


def test_batches_are_half_and_half_and_depend_on_the_step_alone(data):
    shards = load_shards(data)
    batches = Batches(shards, side=16, batch=4, seed=0)
    ahead = dict(batches.between(3, 9))
    assert list(ahead) == [3, 4, 5, 6, 7, 8]
    for got, want in zip(ahead[5], batches[5], strict=True):
        np.testing.assert_array_equal(got, want)
    assert [array.shape for array in batches[0]] == [
        (4, 9, 16, 16),
        (4, 9, 16, 16),
        (4, 1, 16, 16),
        (4, 3, 4, 16, 16),
        (4, 3, 32, 32),
        (4, 2, 16, 16),
    ]


def test_a_batch_has_the_frame_beside_and_the_motion_of_the_later_one(tmp_path):
    """The truth says which frame a crop shows. Frames 3 and 4 go together, 9 with itself; no motion leads there."""
    parts = [
        Sample(n, kind, np.full((16, 16, 35), 0.5), np.full((32, 32, 3), n / 16))
        for n in (3, 4, 9)
        for kind in (FrameKind.SF, FrameKind.EF)
    ]
    write(tmp_path / "one", "one", "training", "occlusion_warp", parts)
    assert [(a.shard.frames[a.index], b.shard.frames[b.index]) for a, b in pairs(load_shards(tmp_path), "training")] == [
        (3, 4),
        (4, 3),
        (9, 9),
    ]
    batches = Batches(load_shards(tmp_path), side=16, batch=2, seed=0)
    for batch in (batches[step] for step in range(9)):
        first, second = batch.truth.mean(axis=(1, 2, 3))
        nowhere = (abs(batch.motion) > 100).all(axis=(1, 2, 3))
        assert nowhere.tolist() == [first <= second, second <= first]


def test_every_folder_of_shards_is_drawn_from_equally_often(tmp_path):
    """However much lies in each, and whatever its detail: here one flat shard beside nine of noise."""
    truths = {"few": np.ones((32, 32, 3)), "many": np.random.default_rng(0).uniform(0, 0.25, (32, 32, 3))}
    for folder, count in (("few", 1), ("many", 9)):
        for i in range(count):
            parts = [Sample(0, kind, np.zeros((16, 16, 35)), truths[folder]) for kind in (FrameKind.SF, FrameKind.EF)]
            write(tmp_path / folder / str(i), f"{folder} {i}", "training", "occlusion_warp", parts)
    batches = Batches(load_shards(tmp_path), side=16, batch=20, seed=0)
    few = np.mean([(batches[step].truth.max(axis=(1, 2, 3)) > 0.5).mean() for step in range(5)])
    assert 0.35 < few < 0.65


def test_a_scene_in_two_splits_is_refused(data, tmp_path):
    sample = Sample(0, FrameKind.SF, np.zeros((16, 16, 35)), np.zeros((32, 32, 3)))
    for split in ("training", "test"):
        write(tmp_path / split, "the same", split, "occlusion_warp", [sample])
    with pytest.raises(InputError, match="scene the same is in the splits"):
        load_shards(tmp_path)


def test_the_rate_rises_and_falls():
    settings = Settings(crop=16, batch=2, rate=1.0, warm_up=10, seed=0, half=False)
    rates = [rate_at(step, 100, settings) for step in range(101)]
    assert max(rates) == rates[9] == 1
    assert sorted(rates[:10]) == rates[:10]
    assert sorted(rates[10:], reverse=True) == rates[10:]
    assert 0 < rates[100] < 0.011


def test_bfloat16_on_the_cpu_trains_too(data):
    settings = Settings(crop=16, batch=2, rate=1e-3, warm_up=1, seed=0, half=True)
    state = start(settings, torch.device("cpu"))
    batch = tensors(Batches(load_shards(data), side=16, batch=2, seed=0)[0], torch.device("cpu"))
    values = [advance(state, batch, 3e-3, Aims(half=True)).item() for _ in range(12)]
    assert values[-1] < values[0]


@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
def test_a_compiled_step_is_the_step(data, monkeypatch):
    """Captured whole as one graph, and the same loss and gradients; what C++ compiler there is does not matter here."""
    monkeypatch.setattr("training.step.compile_objective", lambda: torch.compile(objective, backend="eager", fullgraph=True))
    settings = Settings(crop=16, batch=2, rate=1e-3, warm_up=1, seed=0, half=False)
    batch = tensors(Batches(load_shards(data), side=16, batch=2, seed=0)[0], torch.device("cpu"))
    aims = Aims(squares=0.5, similar=(90.0, 30.0), extrapolated=0.6, holes=2.0)
    states = [start(settings, torch.device("cpu")) for _ in range(2)]
    plain, quick = (advance(s, batch, 1e-3, aims, compiled=compiled) for s, compiled in zip(states, (False, True), strict=True))
    assert abs(plain - quick) < 1e-5 * abs(plain)
    other = dict(states[1].network.named_parameters())
    for name, tensor in states[0].network.named_parameters():
        assert (tensor - other[name]).abs().max() < 1e-5, name


def test_compiling_without_a_compiler_is_one_line(data, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(InputError, match=r"--compile: expected a C\+\+ compiler, g\+\+ or what CXX names; found none"):
        run(data, tmp_path / "run", 4, "--compile")
    assert not (tmp_path / "run").exists()


def test_the_average_of_runs(tmp_path):
    """Numbers that are tiny become 0."""
    one, two = (random(seed) | {"outc.bias": random(seed)["outc.bias"] * np.float32(1e-36)} for seed in (0, 1))
    save(tmp_path / "a.safetensors", one, {"steps": "3"})
    save(tmp_path / "b.safetensors", two, {"steps": "5"})
    files = [str(tmp_path / "a.safetensors"), str(tmp_path / "b.safetensors"), "-o", str(tmp_path / "c.safetensors")]
    average(files)
    result = load(tmp_path / "c.safetensors")
    for name, tensor in result.weights.items():
        mean = (one[name].astype(np.float64) + two[name]) / 2
        np.testing.assert_array_equal(tensor, mean.astype(np.float32) * (name != "outc.bias"))
    assert [record["steps"] for record in json.loads(result.metadata["average_of"])] == ["3", "5"]
    (tmp_path / "d.safetensors").hardlink_to(tmp_path / "a.safetensors")
    with pytest.raises(InputError, match="the same file as"):
        average([str(tmp_path / "a.safetensors"), str(tmp_path / "b.safetensors"), "-o", str(tmp_path / "d.safetensors")])
