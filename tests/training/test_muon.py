"""Muon: the form of its steps, and their descent."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")
torch.set_num_threads(1)

from training.muon import Muon, orthogonal  # noqa: E402


@pytest.mark.parametrize("shape", [(24, 216), (1, 5)])
def test_the_singular_vectors_stay_and_the_values_come_near_one(shape):
    matrices = torch.from_numpy(np.random.default_rng(0).normal(size=(3, *shape)) * [[[1e-3]], [[1.0]], [[50.0]]])
    for matrix, result in zip(matrices, orthogonal(matrices), strict=True):
        u, _, v = torch.linalg.svd(matrix, full_matrices=False)
        core = u.T @ result @ v.T
        values = core.diagonal()
        assert 0.6 < values.min() <= values.max() < 1.3
        assert (core - values.diag()).abs().max() < 1e-12


def test_it_descends_and_leaves_what_has_no_gradient():
    generator = torch.Generator().manual_seed(1)
    still, kernel = (torch.nn.Parameter(torch.randn(8, 4, 3, 3, generator=generator)) for _ in range(2))
    before, target = still.detach().clone(), torch.randn(8, 4, 3, 3, generator=generator)
    optimiser = Muon([still, kernel], 0.1)
    losses = []
    for _ in range(150):
        optimiser.zero_grad()
        loss = (kernel - target).square().mean()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.3 * losses[0]
    assert torch.equal(still, before)
