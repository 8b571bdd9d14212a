"""Dead layers of trained weights are drawn anew, and the image hardly changes."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the package torch is not installed: pip install '.[train]'")
torch.set_num_threads(1)

from stss.weights.file import load, save  # noqa: E402
from training.data import load_shards, places, whole  # noqa: E402
from training.initial import initialise  # noqa: E402
from training.network import Network, load_weights, to_weights  # noqa: E402
from training.revive import main, revive, revive_units, share_of_dead  # noqa: E402


@pytest.fixture
def dead():
    """A network whose ERM and first layer of the decoder are 0 everywhere, with what is constant behind them."""
    network = Network()
    initialise(network, 1)
    with torch.no_grad():
        for name, tensor in network.named_parameters():
            if name.startswith(("latentEncoder", "KEncoder", "up1.conv.double_conv.0")):
                tensor.fill_(-1.0 if name.endswith("bias") else 0.0)
            if name == "up1.conv.double_conv.2.bias":
                tensor.fill_(0.5)
    return network.eval()


def image(network, shards):
    batch = whole(places(shards, "training", "EF")[0])
    with torch.no_grad():
        return network(*(torch.from_numpy(array) for array in batch[:4])).numpy()


def test_dead_units_are_counted(dead, data):
    shares = share_of_dead(dead, load_shards(data))
    assert shares["up1.conv.double_conv.1"] == shares["latentEncoder.1"] == shares["KEncoder.3"] == 1
    assert shares["up3.conv.double_conv.1"] < 0.5


def test_what_is_drawn_anew_is_alive_and_the_image_stays(dead, data, monkeypatch):
    """Without the new kernels of ``up2`` only the border may differ, where the constant part met the padding."""
    monkeypatch.setattr("training.revive.READ", 0.0)
    shards = load_shards(data)
    before = image(dead, shards)
    unread = Network()
    unread.load_state_dict(dead.state_dict())
    with torch.no_grad():
        unread.up2.conv.double_conv[0].weight[:, 24:] = 0
    change = np.abs(image(unread, shards) - before)[..., 12:-12, 12:-12].max()
    revive(dead, shards)
    assert max(share_of_dead(dead, shards).values()) < 0.5
    assert np.abs(image(dead, shards) - before)[..., 12:-12, 12:-12].max() < 0.01 * change


def test_dead_units_at_full_and_half_size_are_drawn_anew_and_the_others_stay(data):
    network, shards, seed = Network().eval(), load_shards(data), 0
    initialise(network, 1)
    while found := revive_units(network, shards, seed):  # of random layers some units are dead by chance
        assert found < 24
        seed += 1
    first = network.up3.conv.double_conv[0]
    with torch.no_grad():
        first.bias[[3, 5]] = -1e3
        network.up3.conv.double_conv[2].bias.fill_(1.0)  # so that none of these dies with them
    before = {name: tensor.clone() for name, tensor in network.named_parameters()}
    assert revive_units(network, shards) == 2
    changed = {name for name, tensor in network.named_parameters() if not torch.equal(tensor, before[name])}
    assert changed == {f"up3.conv.double_conv.{name}" for name in ("0.weight", "0.bias", "2.weight")}
    kept = [i for i in range(24) if i not in (3, 5)]
    assert torch.equal(first.weight[kept], before["up3.conv.double_conv.0.weight"][kept])


def test_the_command_says_what_is_dead_and_writes_weights(dead, data, tmp_path, capsys):
    path, out = tmp_path / "dead.safetensors", tmp_path / "alive.safetensors"
    save(path, to_weights(dead.state_dict()), {})
    main([str(data), "--weights", str(path)])
    assert "latentEncoder.1: 1.00 dead\n" in capsys.readouterr().out
    main([str(data), "--weights", str(path), "-o", str(out)])
    capsys.readouterr()
    main([str(data), "--weights", str(out)])
    assert "latentEncoder.1: 1.00 dead" not in capsys.readouterr().out
    network = Network()
    load_weights(network, load(str(out)).weights)
