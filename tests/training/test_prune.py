"""All below half size becomes its mean: the same image as with that mean, and nothing below is read or trained any more."""

import numpy as np
import pytest

from stss.weights.file import load, save
from stss_cl.liveness import find_live
from stss_ref.weights import BY_NAME, LAYERS, random

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")
torch.set_num_threads(1)

from tests.training.test_network import inputs, tensors  # noqa: E402
from training.network import FEATURES, Network, load_weights  # noqa: E402
from training.prune import main  # noqa: E402
from training.prune import prune as prune_below  # noqa: E402
from training.train import main as train  # noqa: E402


def network_of(weights):
    network = Network()
    load_weights(network, weights)
    return network.eval()


def test_the_mean_is_in_the_bias():
    mean = np.random.default_rng(1).random(32).astype(np.float32)
    weights, batch = random(0), tensors(inputs(0, 48, 40))
    whole, pruned = network_of(weights), network_of(prune_below(weights, mean))
    last = whole.get_submodule(FEATURES["up1"])
    last.register_forward_hook(lambda _m, _i, output: torch.from_numpy(mean)[:, None, None].expand_as(output))
    with torch.no_grad():
        want, got = whole(*batch), pruned(*batch)
    inner = (slice(None), slice(None), slice(16, -16), slice(16, -16))
    assert (got[inner] - want[inner]).abs().max() < 1e-5 < (got[inner] - network_of(weights)(*batch)[inner]).abs().max()


def test_what_is_pruned_is_0_and_stays_so(data, tmp_path):
    tiny = random(0)["conv2.conv_feature.weight"] * np.float32(1e-36)
    save(tmp_path / "whole.safetensors", random(0) | {"conv2.conv_feature.weight": tiny}, {"steps": "1"})
    main([str(data), "--weights", str(tmp_path / "whole.safetensors"), "-o", str(tmp_path / "pruned.safetensors")])
    words = ["--steps", "2", "--crop", "16", "--batch", "2", "--device", "cpu", "--threads", "1"]
    train([str(data), "-o", str(tmp_path / "run"), "--initial", str(tmp_path / "pruned.safetensors"), *words])
    below = [layer for layer in LAYERS if layer.divisor > 2 or layer.component != "backbone"]
    before, after = (load(tmp_path / name).weights for name in ("pruned.safetensors", "run/weights.safetensors"))
    for weights in (before, after):
        assert BY_NAME.keys() - find_live(weights).layers.keys() == {layer.name for layer in below}
        assert not any(weights[name].any() for layer in below for name, _ in layer.tensors())
    assert not before["conv2.conv_feature.weight"].any()
    assert (before["conv1.conv_feature.weight"] != after["conv1.conv_feature.weight"]).any()
