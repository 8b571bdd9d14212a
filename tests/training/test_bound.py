"""What no method can remove: known for pictures made of one edge, and nothing where the input tells all."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the package torch is not installed: pip install '.[train]'")
torch.set_num_threads(1)

from stss.weights.file import save  # noqa: E402
from stss_ground.errors import InputError  # noqa: E402
from stss_ref.weights import random as random_weights  # noqa: E402
from training.bound import BLOCK, PLACES, Twins, alike, errors, main, spread_of_truths  # noqa: E402
from training.network import Network, load_weights  # noqa: E402


def edge(at, columns=6, rows=3):
    """A picture that is 0 to the left of the fine column ``at`` and 1 from there on."""
    planes = np.zeros((BLOCK * rows, BLOCK * columns, 12), np.float32)
    planes[:, at:, :3] = 1
    return Twins(planes)


def test_a_frame_is_every_eighth_ray_and_its_truth_the_mean_around():
    planes = np.zeros((24, 32, 12), np.float32)
    planes[..., 0] = np.arange(24)[:, None]
    planes[..., 1] = np.arange(32)
    twins = Twins(planes)
    for y, x in ((0, 0), (2, 5), (7, 7)):
        seen, truth = twins.inputs(y, x), twins.truth(y, x)
        assert seen.shape == (2, 3, 12)
        np.testing.assert_array_equal(seen[..., 0], [[4 + y] * 3, [12 + y] * 3])
        np.testing.assert_array_equal(seen[0, :, 1], [4 + x, 12 + x, 20 + x])
        # The ray lies in the middle of its pixel: the four truths around it are 2 rays away on either side.
        np.testing.assert_array_equal(truth[:, 0, 0], [2 + y, 6 + y, 10 + y, 14 + y])
        np.testing.assert_array_equal(truth[0, :, 1], [2 + x, 6 + x, 10 + x, 14 + x, 18 + x, 22 + x])


def test_the_edge_s_place_within_a_pixel_is_what_cannot_be_known():
    """Of eight places across a pixel, four see the edge at 24 between the second and third ray, four between the third and fourth.

    Each four see the same, so the error that remains is the variance of their truths.
    """
    twins = edge(24)
    remaining = spread_of_truths(twins, PLACES, (17,))[0]
    expected = []
    for x in range(BLOCK):
        same = [other for other in range(BLOCK) if (other < 4) == (x < 4)]
        truths = np.stack([twins.truth(0, other)[0, :, 0] for other in same])
        expected.append(truths.var(0).mean())
    assert round(float(remaining), 6) == round(float(np.mean(expected)), 6)
    assert remaining > 0.004


def test_whoever_sees_more_is_left_with_less():
    random = np.random.default_rng(0)
    planes = np.zeros((48, 64, 12), np.float32)
    planes[..., :3] = (random.random((6, 8)) < 0.5).repeat(BLOCK, 0).repeat(BLOCK, 1)[..., None]
    remaining = spread_of_truths(Twins(planes), PLACES[:3], (1, 3, 5, 9))
    assert (np.diff(remaining) <= 0).all()
    assert remaining[0] > remaining[2] > 0


def test_nothing_remains_where_the_input_tells_the_place():
    twins = edge(24)
    planes = np.asarray(twins._planes).copy()
    planes[..., 6] = np.arange(planes.shape[1]) / planes.shape[1]
    assert not spread_of_truths(Twins(planes), PLACES[:2]).any()


def test_alike_looks_at_the_surroundings():
    a = np.zeros((5, 5, 2), np.float32)
    b = a.copy()
    b[2, 1, 1] = 0.1
    one, three = alike(a, b, (1, 3))
    assert one.sum() == 24
    assert not one[2, 1]
    assert not three[1:4, :3].any()
    assert three.sum() == 25 - 9
    b[2, 1, 1] = 1 / 255
    assert alike(a, b, (1,))[0].all()


def test_bilinear_s_error_beside_a_network_s():
    network = Network()
    load_weights(network, random_weights(3))
    base, own = errors(edge(24), network.eval(), [(0, 0)])
    truth = edge(24).truth(0, 0)[0, :, 0]
    seen = edge(24).inputs(0, 0)[0, :, 0]
    padded = np.pad(seen, 1, mode="edge")
    between = [0.75 * padded[1 + i // 2] + 0.25 * padded[2 * (i % 2) + i // 2] for i in range(len(truth))]
    assert round(base, 5) == round(float(np.square(np.array(between) - truth).mean()), 5)
    assert own != base


def test_small_frames_are_refused():
    with pytest.raises(InputError, match="16 x 16 or more, got 32 x 15"):
        Twins(np.zeros((15, 32, 12), np.float32))


def test_the_table(tmp_path, capsys):
    path = tmp_path / "w.safetensors"
    save(path, random_weights(3), {})
    main(["--analytic", "2", "--size", "24x16", "--places", "1", "--weights", str(path)])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("|")[1].strip() for line in lines[4:]] == ["film 0", "film 1", "mean"]
    assert all(len(line.split("|")) == 10 for line in lines[2:])
