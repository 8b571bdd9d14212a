"""The last layer as the solution of a linear system."""

import numpy as np
import pytest

from stss.weights.file import load, save
from stss_ref.schedule import FrameKind
from stss_ref.weights import random
from training.samples import Sample, write

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")

from training.data import load_shards, pairs, whole  # noqa: E402
from training.loss import unsteadiness  # noqa: E402
from training.network import Network, load_weights  # noqa: E402
from training.readout import main, solve  # noqa: E402
from training.validate import tensors  # noqa: E402

FRAMES = [(number, kind) for number in (3, 4) for kind in (FrameKind.SF, FrameKind.EF)]


def network_of(weights):
    network = Network()
    load_weights(network, weights)
    return network.eval()


def shard(folder, inputs, truths):
    write(folder, "scene", "training", [Sample(n, kind, x, y) for (n, kind), x, y in zip(FRAMES, inputs, truths, strict=True)])
    return load_shards(folder)


def inputs_at_rest():
    chance = np.random.default_rng(1)
    inputs = chance.random((4, 16, 24, 35)).astype(np.float32)
    inputs[..., [15, 19, 23]], inputs[..., 24:] = 1, 0
    return inputs


def pictures(weights, shards):
    with torch.no_grad():
        return [
            [network_of(weights)(*tensors(whole(place), torch.device("cpu"))[:4])[0] for place in pair]
            for pair in pairs(shards, "training")
        ]


def test_the_layer_that_made_the_truth_is_found(tmp_path):
    right = random(0)
    chance = np.random.default_rng(2)
    wrong = right | {
        name: right[name] + chance.normal(0, 0.02, right[name].shape).astype(np.float32) for name in ("outc.weight", "outc.bias")
    }
    inputs, blank = inputs_at_rest(), np.zeros((4, 32, 48, 3))
    there = shard(tmp_path / "blank", inputs, blank)
    (sf3, ef4), (sf4, ef3) = (([np.moveaxis(p.numpy(), 0, -1) for p in pair]) for pair in pictures(right, there))
    shards = shard(tmp_path / "true", inputs, [sf3, ef3, sf4, ef4])
    save(tmp_path / "wrong.safetensors", wrong, {"steps": "1"})
    main([str(tmp_path / "true"), "--weights", str(tmp_path / "wrong.safetensors"), "-o", str(tmp_path / "new.safetensors")])
    made = load(tmp_path / "new.safetensors").weights

    def error(weights):
        places = [place for pair in pairs(shards, "training") for place in pair]
        seen = [picture for pair in pictures(weights, shards) for picture in pair]
        return np.mean([(a.numpy() - np.moveaxis(p.shard.truth[p.index], -1, 0)) ** 2 for a, p in zip(seen, places, strict=True)])

    assert error(made) < 0.01 * error(wrong)
    assert all((made[name] == wrong[name]).all() for name in wrong if not name.startswith("outc."))


def test_what_flickers_less_is_preferred(tmp_path):
    """The truth stands still; the inputs are noise, so that what the layer adds flickers."""
    weights, still = random(3), np.full((4, 32, 48, 3), 0.5)
    shards = shard(tmp_path / "one", inputs_at_rest(), still)

    def flicker(made):
        found = []
        for pair, chosen in zip(pictures(made, shards), pairs(shards, "training"), strict=True):
            rest = torch.zeros(2, 2, 16, 24)
            rest[0 if chosen[0].shard.frames[chosen[0].index] == 3 else 1] = 1e4
            found.append(float(unsteadiness(torch.stack(pair) - 0.5, rest)))
        return np.mean(found)

    assert flicker(solve(weights, shards, steady=10)) < 0.997 * flicker(solve(weights, shards))
    assert flicker(solve(weights, shards, steady=1, hold=1)) < flicker(weights)
    assert np.allclose(solve(weights, shards, hold=1)["outc.weight"], weights["outc.weight"], atol=1e-4)
