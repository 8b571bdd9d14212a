"""What a part of the input is worth: the least-squares fit finds it where it is known."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the package torch is not installed: pip install '.[train]'")
torch.set_num_threads(1)

from stss.weights.file import save  # noqa: E402
from stss_ref.schedule import FrameKind  # noqa: E402
from stss_ref.weights import random as random_weights  # noqa: E402
from training.data import load_shards, places, whole  # noqa: E402
from training.network import Network, load_weights  # noqa: E402
from training.probe import Probe, main, scores  # noqa: E402
from training.samples import Sample, write  # noqa: E402
from training.validate import bilinear  # noqa: E402

SIZE = 24, 32


def network():
    made = Network()
    load_weights(made, random_weights(3))
    return made


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "w.safetensors"
    save(path, random_weights(3), {})
    return str(path)


def shards(folder, truth):
    """Two splits of random frames; ``truth`` of the batch is (1, 3, 2H, 2W)."""
    random = np.random.default_rng(5)
    for split in ("training", "validation"):
        made = []
        for kind in (FrameKind.SF, FrameKind.EF):
            inputs = random.random((*SIZE, 24))
            inputs[..., [15, 19]] = 1
            inputs[..., 23] = random.random(SIZE) < 0.7
            made.append(Sample(0, kind, inputs, np.zeros((2 * SIZE[0], 2 * SIZE[1], 3))))
        write(folder / split, split, split, made)
        (shard,) = [s for s in load_shards(folder) if s.split == split]
        for sample, place in zip(made, [*places([shard], split, "SF"), *places([shard], split, "EF")], strict=True):
            batch = [torch.from_numpy(a) for a in whole(place)]
            with torch.no_grad():
                image = truth(*batch[:4])[0].numpy()
            sample.truth[...] = np.moveaxis(image, 0, -1)
        write(folder / split, split, split, made)
    return load_shards(folder)


def test_where_the_truth_is_the_network_s_own_every_part_it_reads_counts(tmp_path, weights):
    made = shards(tmp_path, network())
    for kind in ("SF", "EF"):
        found = scores(Probe(weights), made, "validation", kind, 1)
        assert min(found["as they are"], found["last layer refitted"]) > 50
        without_fit = scores(Probe(weights), [s for s in made if s.split != "training"], "validation", kind, 1, as_is=True)
        assert without_fit["as they are"] == found["as they are"]
        assert not any("with the" in name or "refitted" in name for name in without_fit)
        assert without_fit["without ERM"] != without_fit["as they are"] != without_fit["without mask"]
        for part in ("normals", "depth", "roughness, metallic", "base colour", "G-buffer", "mask"):
            assert found[f"without {part}"] < found["last layer refitted"] - 3, part


def test_where_the_truth_is_an_older_frame_the_history_counts_at_full_size_alone(tmp_path, weights):
    def older(color, gbuffer, mask, history):
        difference = history[:, 0, :3] - color[:, :3]
        return bilinear(color, gbuffer, mask, history) + difference.repeat_interleave(2, 2).repeat_interleave(2, 3)

    found = scores(Probe(weights, [weights]), shards(tmp_path, older), "validation", "SF", 1)
    assert found["with the history at full size"] > 50
    assert found["with the history at an eighth"] < found["bilinear"] + 1
    assert found["with the features of 1 more"] < found["bilinear"] + 1


def test_the_table(data, weights, capsys):
    main([str(data), "--weights", weights, "--beside", weights, "--most", "1"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "| | SF | EF |"
    assert [line.split("|")[1].strip() for line in lines[2:5]] == ["bilinear", "as they are", "last layer refitted"]
    assert len(lines) == 15
