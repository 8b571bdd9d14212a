"""The trainable network and loss against the specification."""

import numpy as np
import pytest

from conformance.answers.network import expect_with_weights
from conformance.answers.port_arithmetic import Arithmetic
from conformance.tolerance import ratio
from stss.quality.metrics import C2, PEAK, WINDOW, luma, ssim_map
from stss_cl.liveness import find_live
from stss_ref.loss import loss as reference_loss
from stss_ref.weights import SECOND_COLORS, Weights, zeros
from stss_ref.weights import random as random_weights
from tests.sum_bound import sum_bound

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")
torch.set_num_threads(1)

from training.initial import forget_second_color, hold_gates, hold_history, initialise  # noqa: E402
from training.loss import loss, squared, structure, supervision, trusted  # noqa: E402
from training.network import Heads, Network, load_weights, to_weights  # noqa: E402
from training.train import infancy  # noqa: E402
from training.validate import bilinear  # noqa: E402


def inputs(seed, height=24, width=16):
    random = np.random.default_rng(seed)
    return {
        "color": random.random((height, width, 6)),
        "gbuffer": random.normal(size=(height, width, 9)),
        "mask": (random.random((height, width)) < 0.7).astype(np.float64),
        "history": random.random((3, height, width, 4)),
    }


def tensors(arrays):
    """The arrays as a batch of one."""
    moved = {name: np.moveaxis(array, -1, -3) for name, array in arrays.items() if name != "mask"} | {
        "mask": arrays["mask"][None]
    }
    return [torch.from_numpy(np.ascontiguousarray(moved[n], np.float32))[None] for n in ("color", "gbuffer", "mask", "history")]


def is_the_specification(image, arrays, weights):
    """Whether an image (1, 3, 2H, 2W) is what the specification makes of the arrays."""
    arrays = {name: array.astype(np.float32).astype(np.float64) for name, array in arrays.items()}
    got = np.moveaxis(image[0].numpy(), 0, -1)
    return expect_with_weights("network", arrays, weights, Arithmetic())["image"].ratios(got).max() <= 1


def test_network_is_the_specification_s():
    weights, network, arrays = random_weights(0), Network(), inputs(0)
    load_weights(network, weights)
    with torch.no_grad():
        assert is_the_specification(network(*tensors(arrays)), arrays, weights)
    assert is_the_specification(network(*tensors(arrays)).detach(), arrays, weights)  # training enlarges by matrices


def test_a_network_without_history_is_one_whose_history_is_not_read():
    """Trained without, exported, and run with the history: the same image; and the weights say that the history need not be read."""
    network, whole, arrays = Network("history"), Network(), inputs(4)
    load_weights(network, random_weights(4))
    hold_gates(network)
    hold_history(network)
    weights = to_weights(network.state_dict())
    assert not find_live(weights).reads_history
    assert find_live(random_weights(4)).reads_history
    load_weights(whole, weights)
    with torch.no_grad():
        got, want = (network_(*tensors(arrays)).numpy() for network_ in (network, whole))
    assert ratio("network.float32", got, want) <= 1
    network(*tensors(arrays)).sum().backward()
    still = ("convHis", "lowlevelGated.conv_mask", "lowlevelGated.conv_feature.weight")
    assert all((p.grad is None) == name.startswith(still) for name, p in network.named_parameters())


@pytest.mark.parametrize("second", SECOND_COLORS)
def test_which_second_colour_is_read_belongs_to_the_weights(second):
    """A batch has both. Saved and loaded it stays."""
    arrays, chance = inputs(3), np.random.default_rng(4)
    weights, network = Weights(random_weights(3), second), Network()
    load_weights(network, weights)
    assert to_weights(network.state_dict(), network.second_color).second_color == second
    other = chance.random(arrays["gbuffer"][..., :3].shape).astype(np.float32)
    both = (arrays["color"], other) if second == "newest" else (arrays["color"][..., :3], other, arrays["color"][..., 3:])
    with torch.no_grad():
        image = network(*tensors(arrays | {"color": np.concatenate(both, axis=-1)}))
    assert is_the_specification(image, arrays, weights)


def test_what_was_read_twice_is_read_once():
    """Where both colours are the same, the image stays, whatever the second one is from then on."""
    arrays = inputs(6)
    arrays["color"][..., 3:] = arrays["color"][..., :3]
    network = Network()
    load_weights(network, random_weights(6))
    with torch.no_grad():
        want = network(*tensors(arrays)).numpy()
        forget_second_color(network)
        for network.second_color in SECOND_COLORS:
            assert ratio("network.float32", network(*tensors(arrays)).numpy(), want) <= 1


def test_every_tensor_has_a_gradient():
    network = Network()
    load_weights(network, random_weights(1))
    network(*tensors(inputs(1))).square().mean().backward()
    assert all(tensor.grad is not None and tensor.grad.abs().max() > 0 for tensor in network.parameters())


def test_training_starts_near_bilinear_and_reaches_every_branch():
    """Near: the residual is small. Every input matters from the first step on, the history too, whose gate is held open."""
    network, zero = Network(), Network()
    initialise(network, 0)
    hold_gates(network)
    load_weights(zero, zeros())
    batch = tensors(inputs(4))
    assert torch.equal(zero(*batch), bilinear(*batch))
    with torch.no_grad():
        start = network(*batch)
        assert 0 < (start - bilinear(*batch)).abs().max() < 0.5
        for i in range(4):
            changed = [1 - t if i == j else t for j, t in enumerate(batch)]
            assert not torch.equal(network(*changed) - bilinear(*changed), start - bilinear(*batch))
    assert [name for name, t in network.named_parameters() if not t.requires_grad] == [
        "lowlevelGated.conv_mask.0.weight",
        "lowlevelGated.conv_mask.0.bias",
    ]


def test_loss_is_the_specification_s():
    random = np.random.default_rng(0)
    for mask in ((random.random((8, 12)) < 0.6).astype(np.float64), np.ones((8, 12))):
        output, truth = random.random((2, 16, 24, 3))
        batch = [torch.from_numpy(np.moveaxis(a, -1, 0))[None] for a in (output, truth)]
        got = loss(*batch, trusted(torch.from_numpy(mask)[None, None]), 0.7).item()
        want = reference_loss(output, truth, mask, 0.7)
        assert abs(got - want) <= sum_bound(output.size, abs(want), np.float64)


def test_structure_is_that_of_compare():
    """On pictures of 8 bits the two say the same."""
    random = np.random.default_rng(3)
    pictures = random.integers(0, 256, (2, 3, 40, 56)).astype(np.float64)
    output, truth = (pictures[0] + 2 * pictures[1]) / 3 // 1, pictures[1]
    want = ssim_map(*(luma(np.moveaxis(picture, 0, -1).astype(np.uint8)) for picture in (output, truth))).mean()
    got = structure(*(torch.from_numpy(picture / 255)[None] for picture in (output, truth)))
    # Six moments of at most 1, summed across and down, of which the differences are divided by C2 or more.
    assert abs(1 - got.item() - want) <= sum_bound(2 * WINDOW, 6 * PEAK**2 / C2, np.float64)


def test_the_aids_of_the_first_half():
    """Nothing where the output is right; twice the error counts four times; the heads ask for the truth at each feature's size."""
    truth = torch.rand(2, 3, 32, 48)
    assert squared(truth, truth) == 0
    assert squared(truth + 0.5, truth) > 3.9 * squared(truth + 0.25, truth) > 0
    wrong, nothing = torch.zeros(2, 3, 32, 48), torch.zeros(2, 3, 32, 48)
    wrong[1::2] = 0.5  # in EFs alone
    assert squared(wrong, nothing, 0.75) == 1.5 * squared(wrong, nothing) > 0
    assert squared(nothing + 0.5, nothing, 0.75) == squared(nothing + 0.5, nothing)
    trust = torch.ones(len(nothing), 1, *nothing.shape[2:])
    assert squared(nothing + 0.5, nothing, 0.5, trust, 3.0) == squared(nothing + 0.5, nothing)
    assert squared(nothing + 0.5, nothing, 0.5, 0 * trust, 3.0) == 3 * squared(nothing + 0.5, nothing)
    assert [infancy(step, 100) for step in (0, 25, 50, 99)] == [1, 0.5, 0, 0]

    network, heads, batch = Network(), Heads(), tensors(inputs(3))
    load_weights(network, random_weights(2))
    _, features = network.residual(*batch)
    pictures = heads(features)
    assert [tuple(p.shape[-2:]) for p in pictures] == [(3, 2), (3, 2), (6, 4), (12, 8)]
    truth = torch.rand(1, 3, 48, 32)
    right = [torch.nn.functional.avg_pool2d(truth, 48 // p.shape[-2]) for p in pictures]
    assert supervision(right, truth) == 0
    supervision(pictures, truth).backward()
    deep = ("down3.", "convHis", "lowlevel", "latent", "KEncoder", "up1", "up2")
    assert all(p.grad is not None and p.grad.any() for n, p in network.named_parameters() if n.startswith(deep))
    assert all(p.grad is None for n, p in network.named_parameters() if n.startswith(("up3", "outc")))
