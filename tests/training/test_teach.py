"""Teachers' pictures: turned and turned back, stored beside the truth, and mixed into the squared error's target alone."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the package torch is not installed: pip install '.[train]'")
torch.set_num_threads(1)

from stss.weights.file import save  # noqa: E402
from stss_ref.weights import random as random_weights  # noqa: E402
from training.augment import augment  # noqa: E402
from training.data import Batches, cropped, load_shards, places, whole  # noqa: E402
from training.network import Network, load_weights  # noqa: E402
from training.step import Aims, advance  # noqa: E402
from training.teach import ORIENTATIONS, main, teach, turned, turned_back  # noqa: E402
from training.train import Settings, start  # noqa: E402
from training.validate import tensors  # noqa: E402


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "w.safetensors"
    save(path, random_weights(3), {})
    return str(path)


def network(seed):
    made = Network()
    load_weights(made, random_weights(seed))
    return made.eval()


@pytest.mark.parametrize("way", range(ORIENTATIONS))
def test_a_picture_is_turned_back(way):
    inputs = np.random.default_rng(way).random((6, 10, 24)).astype(np.float32)
    seen = turned(inputs, way, 0.5)
    assert seen.shape == ((10, 6, 24) if way % 2 else (6, 10, 24))
    np.testing.assert_array_equal(turned_back(seen[..., :3], way), inputs[..., :3])
    # The world is mirrored and turned with its picture: lengths of normals stay, and their heights.
    np.testing.assert_array_equal(turned_back(seen[..., 5:6], way), inputs[..., 5:6])
    assert not np.array_equal(turned_back(seen[..., 3:5], way), inputs[..., 3:5])


def test_eight_pictures_of_one_network_are_its_mean_over_all_turns_and_so_turn_with_the_frame():
    """Normals along z, which no turn about z changes: then the eight ways are a group, and the mean of a turned frame is turned."""
    inputs = np.random.default_rng(1).random((16, 16, 24)).astype(np.float32)
    inputs[..., 3:6], inputs[..., [15, 19, 23]] = (0, 0, 1), 1
    one, other = (teach([network(3)], seen, 8, np.random.default_rng(0)) for seen in (inputs, turned(inputs, 5, 0.0)))
    alone = teach([network(3)], inputs, 1, np.random.default_rng(0))
    apart = np.abs(turned_back(other, 5) - one).max()
    assert apart < 0.1 * np.abs(alone - one).max()


def test_pictures_of_several_networks_are_averaged_and_the_training_split_alone_is_taught(data, weights, tmp_path, capsys):
    main([str(data), "--weights", weights, weights, "--pictures", "2", "--threads", "1"])
    assert capsys.readouterr().out == "training\n"
    shards = {shard.split: shard for shard in load_shards(data)}
    assert shards["validation"].taught is None
    assert shards["training"].taught.shape == shards["training"].truth.shape
    main([str(data), "--weights", weights, "--pictures", "1", "--threads", "1"])
    assert capsys.readouterr().out == ""
    for place in (place for kind in ("SF", "EF") for place in places([*shards.values()], "training", kind)):
        inputs, both = cropped(place, (1, 2), 8)
        np.testing.assert_array_equal(inputs, place.shard.inputs[place.index][1:9, 2:10])
        np.testing.assert_array_equal(both[..., :3], place.shard.truth[place.index][2:18, 4:20])
        np.testing.assert_array_equal(both[..., 3:], place.shard.taught[place.index][2:18, 4:20])
    (place,) = places([shards["validation"]], "validation", "SF")
    batch = whole(place)
    np.testing.assert_array_equal(batch.taught, batch.truth)
    batch = Batches([*shards.values()], side=16, batch=2, seed=0)[0]
    assert batch.taught.shape == batch.truth.shape
    assert not np.array_equal(batch.taught, batch.truth)
    for path in data.rglob("taught.npy"):
        path.unlink()


def test_augmentation_does_to_the_teachers_picture_what_it_does_to_the_truth():
    random = np.random.default_rng(2)
    inputs, truth = random.random((8, 8, 24)).astype(np.float32), random.random((16, 16, 3)).astype(np.float32)
    for seed in range(6):
        _, made = augment(inputs, np.concatenate([truth, truth], axis=-1), np.random.default_rng(seed))
        np.testing.assert_array_equal(made[..., :3], made[..., 3:])
        np.testing.assert_array_equal(made[..., :3], augment(inputs, truth, np.random.default_rng(seed))[1])


def test_upright_crops_are_only_mirrored_and_exposed():
    """Green stays green and above stays above, in the inputs and in both pictures; without it, both are mixed."""
    inputs, truth = np.zeros((8, 8, 24), np.float32), np.zeros((16, 16, 6), np.float32)
    inputs[:4, :, 1] = inputs[:4, :, 10] = truth[:8, :, 1] = truth[:8, :, 4] = 0.25
    made = [augment(inputs, truth, np.random.default_rng(seed), upright=True) for seed in range(12)]
    for turned_inputs, turned_truth in made:
        assert (turned_inputs[..., 1] > 0).tolist() == (inputs[..., 1] > 0).tolist() == (turned_inputs[..., 10] > 0).tolist()
        assert (turned_truth > 0).tolist() == (truth > 0).tolist()
    assert len({float(turned_truth.max()) for _, turned_truth in made}) == len(made)
    free = [augment(inputs, truth, np.random.default_rng(seed))[1] for seed in range(12)]
    assert len({tuple(t.max(axis=(0, 1)) > 0) for t in free}) == 3
    assert len({(bool(t[0, 0].any()), bool(t[0, -1].any()), bool(t[-1, 0].any())) for t in free}) == 4


def test_the_teachers_share_is_of_the_squared_error_s_target_alone(data):
    settings = Settings(crop=16, batch=2, rate=0.0, warm_up=0, seed=0, half=False)
    batch = Batches(load_shards(data), side=16, batch=2, seed=0)[0]
    other = batch._replace(taught=batch.truth + np.float32(0.1))

    def value(batch, **options):
        return advance(start(settings, torch.device("cpu")), tensors(batch, torch.device("cpu")), 0.0, Aims(**options)).item()

    assert value(other, squares=0.5) == value(batch, squares=0.5) == value(batch, squares=0.5, share=0.5)
    assert value(other, squares=0.0, share=0.5) == value(batch, squares=0.0)
    assert value(other, squares=0.5, share=0.5) != value(batch, squares=0.5)
