"""The ablations: each leaves out what it says, and the table is one."""

import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")
torch.set_num_threads(1)

from stss_ref.weights import random as random_weights  # noqa: E402
from tests.training.test_network import inputs, tensors  # noqa: E402
from training.ablate import COLUMNS, VARIANTS, main  # noqa: E402
from training.network import Network, leak, load_weights  # noqa: E402


def network(without=""):
    made = Network(without)
    load_weights(made, random_weights(0))
    return made


@pytest.mark.parametrize(("without", "position"), [("gbuffer", 1), ("history", 3)])
def test_what_is_left_out_has_no_effect(without, position):
    batch, other = tensors(inputs(0)), tensors(inputs(0))
    other[position] = other[position].flip(-1)
    with torch.no_grad():
        assert torch.equal(network(without)(*batch), network(without)(*other))
        assert not torch.equal(network()(*batch), network()(*other))


def test_without_erm_the_light_stays_where_it_is():
    """A change at one place reaches the window of ERM's 5 x 5 only with it: seen in the bottleneck itself."""
    x4, gbuffer, mask = torch.rand(1, 32, 9, 9), torch.rand(1, 9, 72, 72), torch.ones(1, 1, 72, 72)
    nearer = mask.clone()
    nearer[..., :8, :8] = 0
    with torch.no_grad():
        for without, reached in (("erm", 1), ("", 9)):
            changed = (network(without).reshade(x4, gbuffer, mask) != network(without).reshade(x4, gbuffer, nearer)).any(1)
            assert int(changed.sum()) == reached


def test_a_leaky_network_is_the_specification_s_once_the_slope_is_0():
    batch, one = tensors(inputs(1)), network()
    with torch.no_grad():
        exact = one(*batch)
        leak(one, 0.1)
        assert not torch.equal(one(*batch), exact)
        leak(one, 0.0)
        assert torch.equal(one(*batch), exact)


def test_the_table(data, capsys):
    main(
        [str(data), "--split", "validation", "--steps", "1", "--crop", "16", "--batch", "2", "--device", "cpu", "--threads", "1"]
    )
    rows = [line.strip("|").split("|") for line in capsys.readouterr().out.splitlines()]
    assert [row[0].strip() for row in rows] == ["", "---", "bilinear", *(variant.name for variant in VARIANTS)]
    cells = {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows}
    assert all(len(row) == len(COLUMNS) for row in cells.values())
    assert cells["SF alone"][0]
    assert not any(cells["SF alone"][2:])
    assert not any(cells["EF alone"][:2])
    assert cells["whole"][0] != cells["bilinear"][0]
