"""The paper's rivals: what they read, a step of training, and frames in a folder."""

import json

import numpy as np
import pytest

from stss.demo import write_demo_sequence
from stss.images.color import transfer
from stss.images.read_write import read_rgb
from stss_ground.errors import InputError
from stss_ref.frame import NetworkInputs
from training.samples import write_film

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")

from safetensors.torch import save_file  # noqa: E402

from training.loss import led_along  # noqa: E402
from training.rivals import cost, run, samples, train  # noqa: E402
from training.rivals.networks import EARLIER, NSRR, PLANES, ExtraNet, spread_out  # noqa: E402
from training.train import Settings  # noqa: E402

SIZE = (24, 32)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("films")
    write_film(1, "aliased", SIZE, "occlusion_warp", folder / "films")
    index = folder / "films" / "analytic-00001-aliased" / "index.json"
    index.write_text(json.dumps(json.loads(index.read_text()) | {"split": "training"}))
    samples.main([str(folder / "films"), "-o", str(folder / "five")])
    return folder / "five"


def ghosts(inputs):
    """How far the earlier colours, led along their motions, are from the newest: mean of each of (N, H, W, 54)."""
    frames = torch.from_numpy(np.moveaxis(inputs[..., train.FRAMES :], -1, 1).astype(np.float32).copy())
    pictures, motions = frames[:, :PLANES].unflatten(1, (-1, 4)), frames[:, PLANES:].unflatten(1, (-1, 2))
    large = torch.nn.functional.interpolate(pictures[:, 1:].flatten(0, 1), scale_factor=2)
    warped, inside = led_along(large, motions.flatten(0, 1))
    there = torch.nn.functional.interpolate(pictures[:, :1].expand(-1, EARLIER, -1, -1, -1).flatten(0, 1), scale_factor=2)
    return float(((warped - there).abs().mean(1) * inside).sum() / inside.sum())


def test_motions_lead_to_the_same_surface_however_the_picture_is_turned(data):
    drawn = train.batches(data, "nsrr", 24, 2, 0)
    shard = np.load(data / "analytic-00001-aliased" / "inputs.npy").astype(np.float32)
    truth = np.load(data / "analytic-00001-aliased" / "truth.npy").astype(np.float32)
    before = ghosts(shard)
    still = shard.copy()
    still[..., train.FRAMES + PLANES :] = 0
    assert before < 0.7 * ghosts(still)
    for seed in range(6):
        turned, _ = drawn.augment(shard, truth, np.random.default_rng(seed))
        assert ghosts(turned) == pytest.approx(before, rel=0.4)


def test_networks_have_the_sizes_of_their_frames():
    color, gbuffer, mask, history = cost.inputs_of("extranet", 48, 32)
    assert ExtraNet()(color, gbuffer, mask, history).shape == (1, 3, 16, 24)
    assert NSRR()(*cost.inputs_of("nsrr", 48, 32)).shape == (1, 3, 32, 48)
    x = torch.rand(1, 2, 3, 4)
    assert torch.equal(spread_out(x)[..., ::2, ::2], x)
    assert spread_out(x).sum() == pytest.approx(float(x.sum()))


@pytest.mark.parametrize("name", ["extranet", "nsrr"])
def test_a_few_steps_lower_the_loss(data, name):
    batch = train.tensors(train.batches(data, name, 16, 2, 0)[0], torch.device("cpu"))
    state, settings = train.start(train.make(name)), Settings(16, 2, 0.003, 1, 0, False)
    losses = [train.advance(name, state, batch, settings, 100) for _ in range(8)]
    assert losses[-1] < losses[0]


def test_shards_without_the_frames_are_one_line(data, tmp_path):
    with pytest.raises(InputError, match=r"rivals\.samples"):
        train.batches(data.parent / "films", "nsrr", 16, 2, 0)
    with pytest.raises(InputError, match="no analytic films"):
        samples.main([str(tmp_path), "-o", str(tmp_path / "out")])


def test_every_chain_writes_frames_and_scores(tmp_path, monkeypatch):
    write_demo_sequence(tmp_path, 5, (16, 24))
    for name in train.NETWORKS:
        save_file({key: t.contiguous() for key, t in train.make(name).named_parameters()}, tmp_path / name)
    monkeypatch.setattr(run, "rife", lambda: lambda two, *_: [0, 0, [0, 0, 0, (two[:, :3] + two[:, 3:]) / 2]])
    given = ["frames", "truth", "-o", "out", "--extranet", "extranet", "--nsrr", "nsrr", "--methods"]
    given = [argument if argument.startswith("-") else str(tmp_path / argument) for argument in given]
    run.main([*given, *run.CHAINS, "--rendered", "even"])
    for chain in run.CHAINS:
        assert len(list((tmp_path / "out" / chain).glob("frame.*.exr"))) == 5
    first, second, third = (read_rgb(path) for path in sorted((tmp_path / "frames").glob("*.exr"))[:3])
    shown = [transfer("srgb").encode(color) for color in (first, second, third)]
    chain = run.Chain("rife+nsrr", {}, dict(enumerate(shown)).get)
    prepared = NetworkInputs(*(np.zeros((*first.shape[:2], 6), np.float32) for _ in range(4)))
    assert np.allclose(chain._make_small(1, prepared), (shown[0] + shown[2]) / 2, atol=1e-6)
    assert chain.small == [pytest.approx(-10 * np.log10(np.mean(((shown[0] + shown[2]) / 2 - shown[1]) ** 2)), abs=1e-4)]
    with pytest.raises(InputError, match="needs frames 1 and 3"):
        chain._make_small(2, prepared)


def test_multiply_adds_are_counted(capsys):
    cost.main(["--size", "32x32", "--rows", "stss", "extranet", "--engines", "pytorch", "--repeat", "1", "--threads", "1"])
    printed = capsys.readouterr().out
    assert "stss: 0.417 M parameters" in printed
    assert "extranet, pytorch:" in printed
