"""Samples, augmentation and batches."""

import json

import click
import numpy as np
import pytest

from conformance.scenes import SCENES
from stss.frames.display_frame import OnArrays, make_display_frame
from stss.frames.supersampler import Supersampler
from stss.images.read_write import write_channels, write_rgb
from stss_ground.errors import InputError
from stss_ref.constants import HOLE_FILLS
from stss_ref.detail import LUMA
from stss_ref.resample import upsample_centres
from stss_ref.schedule import FrameKind
from tests.app.conftest import frame_channels
from training import samples as module
from training.augment import ACROSS, DOWN, LEVEL, MASK, MOTION, NORMAL, augment, collate, depths_at_random, mask_at_random
from training.samples import film_frames, samples, split_of, unpack
from training.scenes import INPUTS, Film, random_film

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")

from training.loss import unsteadiness  # noqa: E402

SIZE = (24, 32)


@pytest.fixture(scope="module")
def film():
    scene = SCENES["object"]
    return Film(scene, lambda frame: scene.light)


class Bilinear(OnArrays):
    name = "bilinear"

    def __init__(self, fill):
        super().__init__()
        self.fill = fill

    def frame(self, inputs):
        prepared = module.prepare(inputs, hole_fill=self.fill)
        return upsample_centres(prepared.color[..., :3]), prepared.mask.astype(bool)


@pytest.mark.parametrize("fill", HOLE_FILLS)
def test_samples_are_what_the_tool_feeds_the_network(film, fill):
    """Frame by frame the colours are those that `Supersampler` upsamples in a run at half rate."""
    curve = module.transfer("srgb")
    buffers = [module.replace(b, color=np.minimum(b.color, 1)) for b in film_frames(film, SIZE, 8)]
    frames = [make_display_frame(b, curve, "scale") for b in buffers]
    parts = list(samples(frames, {n: np.zeros((48, 64, 3), np.float32) for n in (6, 7)}, fill))
    assert [(s.number, s.kind.value) for s in parts] == [(6, "SF"), (6, "EF"), (7, "SF"), (7, "EF")]
    for odd in (0, 1):
        half = [b if b.number % 2 == odd else module.replace(b, color=None) for b in buffers]
        outputs = {output.number: output for output in Supersampler(backend=Bilinear(fill))(half)}
        for sample in (s for s in parts if (s.number % 2 == odd) == (s.kind is FrameKind.SF)):
            inputs = unpack(sample.inputs)
            image = curve.decode(upsample_centres(inputs.color[..., :3]))
            np.testing.assert_array_equal(image, outputs[sample.number].image)
            np.testing.assert_array_equal(inputs.mask.astype(bool), outputs[sample.number].valid)
    assert not list(samples(frames[:1], {0: np.zeros((48, 64, 3), np.float32)}, fill))  # nothing lies before it
    window = frames[2:8]
    planes_in = module.frame_inputs([module.replace(f, color=None) if f.number % 2 else f for f in window], (1, 3, 5))
    details = np.stack([parts[3].inputs[..., part] @ LUMA for part in (ACROSS, DOWN, LEVEL)], axis=-1)
    np.testing.assert_allclose(
        details, module.prepare(planes_in, second="detail", hole_fill=fill).color[..., 3:], rtol=0, atol=1e-6
    )
    assert np.abs(details).max() > 0.01


def test_random_films_differ_and_repeat():
    images = [next(film_frames(random_film(seed), SIZE, 1)).color for seed in (1, 1, 2)]
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).any()


@pytest.mark.parametrize("inputs", INPUTS)
def test_inputs_say_what_is_a_mean_over_the_pixel(inputs):
    sharp, blurred = (next(film_frames(random_film(3, kind), SIZE, 1)) for kind in ("aliased", inputs))
    for name in ("color", "normal", "depth"):
        assert (getattr(blurred, name) != getattr(sharp, name)).any() == (name in INPUTS[inputs])


def test_a_scene_is_in_one_split():
    splits = [split_of(f"analytic-{n:05d}") for n in range(1000)]
    assert all(70 <= splits.count(name) <= 130 for name in ("validation", "test"))
    assert split_of("analytic-00000") == splits[0]


def test_augmentation_keeps_what_belongs_together():
    """Where all pictures are one picture, they still are; normals keep their length and their up, y or z; masks stay masks."""
    random = np.random.default_rng(3)
    inputs = np.zeros((16, 16, 35), np.float32)
    picture = random.random((16, 16, 3)).astype(np.float32)
    for first in (0, 12, 16, 20):
        inputs[..., first : first + 3] = picture
    inputs[..., [15, 19, 23]] = random.integers(0, 2, (16, 16, 1))
    inputs[..., NORMAL] = [0.6, 0, 0.8]
    truth, ups = picture.repeat(2, 0).repeat(2, 1), list[int | None]()
    for seed in range(8):
        (new,), (large,) = augment(inputs[None], truth[None], np.random.default_rng(seed))
        for first in (12, 16, 20):
            np.testing.assert_array_equal(new[..., first : first + 3], new[..., :3])
        np.testing.assert_array_equal(large[::2, ::2], new[..., :3])
        np.testing.assert_array_equal(np.unique(new[..., [15, 19, 23]]), [0, 1])
        normal = new[0, 0, NORMAL]
        ups.append(int(normal.argmax()) if normal.max() == np.float32(0.8) else None)
        np.testing.assert_array_equal(new[..., NORMAL], np.broadcast_to(normal, (16, 16, 3)))
        assert abs(np.linalg.norm(normal) - 1) < 1e-6
    assert {*ups} == {1, 2}
    (new,), (large,) = augment(inputs[None], truth[None], np.random.default_rng(0), how="none")
    np.testing.assert_array_equal(new, inputs)
    np.testing.assert_array_equal(large, truth)


def test_motion_turns_with_the_picture():
    """A picture that moved by (2, -1) pixels: however a pair is turned and mirrored, its motion leads to the same colours."""
    random = np.random.default_rng(5)
    inputs, picture = np.zeros((2, 16, 16, 35), np.float32), random.random((32, 32, 3)).astype(np.float32)
    inputs[0, ..., MOTION], inputs[1, ..., MOTION] = module.NOWHERE, (2, -1)
    truth = np.stack([picture, np.roll(picture, (2, -4), (0, 1))])
    motions = set()
    for seed in range(24):
        new, large = augment(inputs, truth, np.random.default_rng(seed))
        motions.add(tuple(new[1, 0, 0, MOTION]))
        error = torch.from_numpy(np.moveaxis(large, -1, 1).copy())
        motion = torch.from_numpy(np.moveaxis(new[..., MOTION], -1, 1).copy())
        assert unsteadiness(error, motion) < 1e-5
        assert unsteadiness(error, -motion) > 0.1
    assert motions == {(2, -1), (-2, -1), (2, 1), (-2, 1), (1, 2), (-1, 2), (1, -2), (-1, -2)}


def test_details_turn_with_the_picture():
    """The differences within the pixels of a picture: however it is turned, mirrored and coloured, they are those of the new one."""

    def within(large):
        a, b, c, d = (large[y::2, x::2] for y in (0, 1) for x in (0, 1))
        return (b - a + d - c) / 2, (c - a + d - b) / 2

    random = np.random.default_rng(5)
    truth, inputs = random.random((32, 32, 3)).astype(np.float32) * 0.7, np.zeros((16, 16, 35), np.float32)
    inputs[..., ACROSS], inputs[..., DOWN] = within(truth)
    for seed in range(24):
        (new,), (large,) = augment(inputs[None], truth[None], np.random.default_rng(seed))
        for part, want in zip((ACROSS, DOWN), within(large), strict=True):
            np.testing.assert_allclose(new[..., part], want, rtol=0, atol=1e-6)


@pytest.mark.parametrize("between", [(0.01, 0.05), (0.6, 0.95)])
def test_depths_keep_their_order_and_the_background_while_their_middle_moves(between):
    """A plain whose depths lie in a twentieth of the range becomes one that fills it, a far one comes near; one crop in four stays."""
    depth = np.random.default_rng(4).uniform(*between, (16, 16)).astype(np.float32)
    depth[:4] = 1
    order = np.argsort(depth, axis=None, kind="stable")
    middles = []
    for seed in range(200):
        new = depths_at_random(depth, np.random.default_rng(seed))
        assert new.dtype == np.float32
        assert (new[:4] == 1).all()
        assert (new >= 0).all()
        assert (new <= 1).all()
        assert (np.diff(new.ravel()[order]) >= 0).all()
        middles.append(np.median(new[4:]))
    same = np.median(depth[4:])
    moved = [middle for middle in middles if middle != same]
    assert 130 <= len(moved) <= 170
    assert 0.039 <= min(moved) < 0.06
    assert 0.5 < max(moved) <= 0.71
    nothing = np.ones((8, 8), np.float32)
    assert (depths_at_random(nothing, np.random.default_rng(0)) == 1).all()


def test_rrm_touches_the_newest_mask_alone():
    inputs = np.ones((16, 16, 35), np.float32)
    mask = mask_at_random(inputs, np.random.default_rng(0))
    assert 0 < (mask == 0).sum() <= 16
    batch = collate(inputs[None], mask[None], np.ones((1, 32, 32, 3)))
    assert (batch.mask == 0).sum() == (mask == 0).sum()
    assert batch.history.all()
    assert inputs[..., MASK].all()


def test_a_shard_is_whole_or_not_there(tmp_path):
    sample = module.Sample(3, FrameKind.SF, np.full((8, 8, 35), 0.5), np.full((16, 16, 3), 0.25))
    assert module.write(tmp_path / "one", "scene", "test", "occlusion_warp", [sample]) == 1
    index = json.loads((tmp_path / "one" / "index.json").read_text())
    assert index == {"scene": "scene", "split": "test", "frames": [3], "kinds": ["SF"], "hole_fill": "occlusion_warp"}
    broken = module.replace(sample, truth=np.full((16, 16, 3), np.inf))
    with pytest.raises(InputError, match="two: truth: not finite"):
        module.write(tmp_path / "two", "scene", "test", "occlusion_warp", [broken])
    assert [path.name for path in tmp_path.iterdir() if not path.name.startswith(".")] == ["one"]


def test_a_film_of_another_fill_size_or_split_is_made_again(tmp_path, capsys):
    words = ["-o", str(tmp_path), "--analytic", "1", "--size", "32x24", "--hole-fill"]
    for more, count in (
        (["occlusion_warp"], "8 samples"), (["occlusion_warp"], "there"), (["reshade"], "8 samples"),
        (["reshade", "--size", "24x32"], "8 samples"), (["reshade", "--size", "24x32", "--split", "test"], "8 samples"),
    ):  # fmt: skip
        module.main([*words, *more])
        assert capsys.readouterr().out.endswith(f": {count}\n")
    assert json.loads((tmp_path / "analytic-00000-aliased" / "index.json").read_text())["split"] == "test"


def test_samples_of_nothing_are_refused(tmp_path):
    with pytest.raises(InputError, match="expected --sequence LR HR or --analytic N, found neither"):
        module.main(["-o", str(tmp_path / "out"), "--split", "training"])


def test_frames_rendered_at_half_rate_are_refused_and_nothing_is_left(tmp_path):
    """Such as those of ``stss demo``, the first that a user has."""
    low, high = tmp_path / "lr", tmp_path / "hr"
    low.mkdir()
    high.mkdir()
    write_rgb(high / "a.0000.exr", np.ones((16, 16, 3), np.float32))
    for number in range(4):
        write_channels(low / f"a.{number:04d}.exr", frame_channels(number, (8, 8), number % 2 == 0))
    with pytest.raises(InputError, match=r"lr: frame 1 has no colour; expected the colour of every frame"):
        module.main(["-o", str(tmp_path / "out"), "--sequence", str(low), str(high), "--split", "training"])
    assert not (tmp_path / "out").exists()


def test_a_shard_replaces_nothing_else(tmp_path):
    """By default it has the name of the folder above LR, where the renders are."""
    films = tmp_path / "films"
    for name in ("kitchen/lr", "kitchen/hr", "other", "shard"):
        (films / name).mkdir(parents=True)
    (films / "kitchen" / "lr" / "frame.0001.exr").write_bytes(b"hours of rendering")
    (films / "other" / "index.json").write_text("mine")
    (films / "other" / "notes.txt").write_text("mine")
    for name in module.FILES:
        (films / "shard" / name).write_text("old")
    (films / "link").symlink_to(films / "shard")
    before = set(tmp_path.rglob("*"))
    low, high = films / "kitchen" / "lr", films / "kitchen" / "hr"
    words = ["-o", str(films), "--sequence", str(low), str(high)]
    for more, message in (
        ([], "above or below"), (["--name", "other"], "a shard of"), (["--name", "link"], "a shard of"),
        (["--name", "../films"], "without separators"), (["--name", ".."], "without separators"),
        (["-o", str(low), "--name", "x"], "above or below"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            module.main([*words, *more])
    assert set(tmp_path.rglob("*")) == before
    module.require_shard(films / "shard", [low, high])
    module.require_shard(films / "new", [low, high])


def test_the_profile_is_the_one_whose_channels_the_files_have(tmp_path, capsys):
    """As for ``stss run``: frames of the project's own layout need no ``--profile``."""
    low, high = tmp_path / "lr", tmp_path / "hr"
    for folder in (low, high):
        folder.mkdir()
    for number in range(7):
        write_channels(low / f"a.{number:04d}.exr", frame_channels(number, (16, 24)))
    write_channels(high / "a.0006.exr", {name: np.full((32, 48), 0.5) for name in "RGB"})
    module.main(["-o", str(tmp_path / "out"), "--sequence", str(low), str(high), "--name", "mine"])
    assert capsys.readouterr().out.startswith("mine: 2 samples for ")


def test_a_truth_of_another_scene_is_suspected(tmp_path, capsys):
    low, high = tmp_path / "lr", tmp_path / "hr"
    for folder in (low, high):
        folder.mkdir()
    half = {name: np.full((16, 24), 0.5) for name in "RGB"}
    for number in range(7):
        write_channels(low / f"a.{number:04d}.exr", frame_channels(number, (16, 24)) | half)
    write_channels(high / "a.0006.exr", {name: np.full((32, 48), 0.5) for name in "RGB"})
    words = ["-o", str(tmp_path / "out"), "--sequence", str(low), str(high), "--name", "mine", "--split", "test"]
    module.main(words)
    assert capsys.readouterr().out == "mine: 2 samples for test; bilinear upsampling has 99.0 dB\n"
    write_channels(high / "a.0006.exr", {name: np.full((32, 48), 0.01) for name in "RGB"})
    module.main(words)
    assert f"; below 15: is {high} the truth of {low}?" in capsys.readouterr().out


@pytest.mark.parametrize("domain", ["linear", "display"])
def test_colours_and_depths_are_those_that_a_run_reads(tmp_path, domain):
    """By the profile, a truth in PNG as well: display-referred colours got the sRGB curve a second time."""
    low, high = tmp_path / "lr", tmp_path / "hr"
    for folder in (low, high):
        folder.mkdir()
    half = {name: np.full((16, 24), 0.5) for name in ("R", "G", "B", "depth.Z")}
    for number in range(6):
        write_channels(low / f"a.{number:04d}.exr", frame_channels(number, (16, 24)) | half)
    write_channels(high / "a.0004.exr", {name: np.full((32, 48), 0.5) for name in "RGB"})
    write_rgb(high / "a.0005.png", np.full((32, 48, 3), 0.25, np.float32))
    profile = tmp_path / "mine.toml"
    profile.write_text(f'base = "stss"\ncolor_domain = "{domain}"\ndepth_normalisation = "clip"\n')
    module.main(["-o", str(tmp_path / "out"), "--sequence", str(low), str(high), "--name", "mine", "--profile", str(profile)])
    grey = 0.5 if domain == "display" else 0.7354
    truth, inputs = (np.load(tmp_path / "out" / "mine" / f"{name}.npy") for name in ("truth", "inputs"))
    index = json.loads((tmp_path / "out" / "mine" / "index.json").read_text())
    for frame, value in ((4, grey), (5, 0.25)):
        np.testing.assert_allclose(truth[index["frames"].index(frame)], value, atol=2e-3)
    first = inputs[index["kinds"].index("SF")]
    np.testing.assert_allclose(first[..., :3], grey, atol=2e-3)
    np.testing.assert_allclose(first[..., 6], 0.5, atol=2e-3)


def test_options_of_a_run_read_the_sequence(tmp_path):
    """A check that recommends ``--roughness`` is of no use where the samples do not take it."""
    low, high = tmp_path / "lr", tmp_path / "hr"
    for folder in (low, high):
        folder.mkdir()
    for number in range(7):
        channels = frame_channels(number, (16, 24))
        del channels["roughness.X"]
        write_channels(low / f"a.{number:04d}.exr", channels)
    write_channels(high / "a.0006.exr", {name: np.full((32, 48), 0.5) for name in "RGB"})
    words = ["-o", str(tmp_path / "out"), "--sequence", str(low), str(high), "--name", "mine"]
    with pytest.raises(InputError, match="no roughness"):
        module.main(words)
    module.main([*words, "--roughness", "0.25"])
    assert (np.load(tmp_path / "out" / "mine" / "inputs.npy")[..., 7] == 0.25).all()
    with pytest.raises(click.BadParameter):
        module.main([*words, "--roughness", "2"])
