"""The paper's rivals: their inputs, a step of training, and frames in a folder."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from stss.demo import write_demo_sequence
from stss.frames import display_frame
from stss.images.color import transfer
from stss.images.read_write import read_rgb, write_channels
from stss.quality.metrics import psnr, to_8bit
from stss.sequence.reader import open_sequence
from stss.weights.file import ALIASED, MADE_FOR, save
from stss_ground.errors import InputError
from stss_ref.frame import NetworkInputs, prepare
from stss_ref.resample import upsample_centres
from stss_ref.weights import zeros
from tests.app.conftest import frame_channels
from training import samples as training_samples
from training.samples import write_film

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")

from safetensors.torch import save_file  # noqa: E402

from stss.frames.backends import NETWORK  # noqa: E402
from training.augment import AUGMENTS  # noqa: E402
from training.loss import led_along  # noqa: E402
from training.rivals import authors, cost, jittered, nss, run, samples, train, validate, wgsl_upscaler  # noqa: E402
from training.rivals.networks import EARLIER, NSRR, PLANES, ExtraNet, spread_out  # noqa: E402
from training.train import Settings  # noqa: E402

SIZE = (24, 32)
CHAIN = "extranet+nsrr"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("films")
    write_film(1, "aliased", SIZE, "occlusion_warp", "training", folder / "films")
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
    batches = train.batches(data, "nsrr", 24, 2, 0)
    shard = np.load(data / "analytic-00001-aliased" / "inputs.npy").astype(np.float32)
    truth = np.load(data / "analytic-00001-aliased" / "truth.npy").astype(np.float32)
    before = ghosts(shard)
    still = shard.copy()
    still[..., train.FRAMES + PLANES :] = 0
    assert before < 0.7 * ghosts(still)
    for seed in range(6):
        turned, _ = batches.augment(shard, truth, np.random.default_rng(seed))
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
    with pytest.raises(InputError, match="no shards"):
        samples.main([str(tmp_path), "-o", str(tmp_path / "out")])


def test_a_sequence_is_validated_as_a_run_of_it_scores(tmp_path, capsys):
    """On a renderer's frames: the means over shards are those of the frames that the chain writes, each as SF and as EF."""
    low, high = tmp_path / "clips" / "one" / "lr", tmp_path / "clips" / "one" / "hr"
    for folder in (low, high):
        folder.mkdir(parents=True)
    for number in range(11):
        planes = frame_channels(number, (24, 32))
        colors = {name: planes[name] / 2 for name in "RGB"}  # a run adds light above 1 after the network
        write_channels(low / f"a.{number:04}.exr", planes | colors)
        for folder in (tmp_path / "all", *([high] if number > 8 else [])):
            folder.mkdir(exist_ok=True)
            write_channels(
                folder / f"a.{number:04}.exr", {name: plane.repeat(2, 0).repeat(2, 1) for name, plane in colors.items()}
            )
    training_samples.main(["--sequence", str(low), str(high), "--split", "validation", "-o", str(tmp_path / "shards")])
    words = [str(tmp_path / "shards"), "-o", str(tmp_path / "five")]
    with pytest.raises(InputError, match="expected --clips"):
        samples.main(words)
    samples.main([*words, "--clips", str(tmp_path / "clips")])
    networks = {name: train.make(name) for name in train.NETWORKS}
    for name, network in networks.items():
        with torch.no_grad():
            network.outc.bias.copy_(torch.tensor([0.1, -0.1, 0.05]))
        save_file({key: t.contiguous() for key, t in network.named_parameters()}, tmp_path / name)
    files = [word for name in train.NETWORKS for word in (f"--{name}", str(tmp_path / name))]
    validate.main([str(tmp_path / "five"), *files])
    means = json.loads(capsys.readouterr().out.splitlines()[-1].partition(": ")[2])
    curve, found = transfer("srgb"), {"SF": [], "EF": []}
    for rendered in ("even", "odd"):
        out = tmp_path / rendered
        run.main([str(low), str(tmp_path / "all"), "-o", str(out), "--rendered", rendered, *files, "--methods", CHAIN])
        for number in (9, 10):
            image, truth = (
                curve.encode(read_rgb(path)) for path in (out / CHAIN / f"frame.{number:04}.exr", high / f"a.{number:04}.exr")
            )
            found["SF" if (number % 2 == 0) == (rendered == "even") else "EF"].append(psnr(to_8bit(image), to_8bit(truth)))
    assert {kind: means[kind] for kind in found} == {kind: pytest.approx(np.mean(v), abs=0.05) for kind, v in found.items()}
    assert abs(means["SF"] - means["EF"]) > 0.2


def test_every_chain_writes_frames_and_scores(tmp_path, monkeypatch):
    write_demo_sequence(tmp_path, 5, (16, 24))
    for name in train.NETWORKS:
        save_file({key: t.contiguous() for key, t in train.make(name).named_parameters()}, tmp_path / name)
    torch.save({"state_dict": authors.AuthorsExtraNet().state_dict()}, tmp_path / "authors")
    monkeypatch.setattr(run, "rife", lambda: lambda two, *_: [0, 0, [0, 0, 0, (two[:, :3] + two[:, 3:]) / 2]])
    options = [str(tmp_path / "frames"), str(tmp_path / "truth"), "-o", str(tmp_path / "out"), "--rendered", "even"]
    files = [word for name in ("extranet", "nsrr", "authors") for word in (f"--{name}", str(tmp_path / name))]
    methods = (*run.CHAINS, "lanczos", "lanczos+rife", "taau")
    with monkeypatch.context() as patch:
        patch.setattr(run, "open_upsampler", None)  # without --jitter taau is that of stss methods
        run.main([*options, *files, "--methods", *methods])
    for method in methods:
        assert len(list((tmp_path / "out" / method).glob("frame.*.exr"))) == 5, method

    def picture(folder, number):
        return curve.encode(read_rgb(tmp_path / folder / f"frame.{number:04}.exr"))

    curve, files = transfer("srgb"), open_sequence(tmp_path / "frames")
    frames = [curve.encode(np.full((16, 24, 3), value, np.float32)) for value in (0.1, 0.2, 0.6)]
    window = [display_frame.make_display_frame(files.load(number), curve, "scale") for number in range(2)]
    every = run.RenderedFrames(run.EVERY, dict(enumerate(frames)).get, curve)
    np.testing.assert_array_equal(every.compute(window, (1, 1, 1))[0], upsample_centres(frames[1]))
    with pytest.raises(InputError, match="every: frame 1 was not rendered"):
        run.RenderedFrames(run.EVERY, {}.get, curve).compute(window, (1, 1, 1))
    lanczos, between = ([picture(f"out/{name}", number) for number in range(3)] for name in ("lanczos", "lanczos+rife"))
    assert np.abs(between[0] - lanczos[0]).max() < 2e-3
    assert np.abs(between[1] - (lanczos[0] + lanczos[2]) / 2).max() < 4e-3
    chain = run.Chain("rife+nsrr", {}, dict(enumerate(frames)).get)
    prepared = NetworkInputs(*(np.zeros((*frames[0].shape[:2], 6), np.float32) for _ in range(4)))
    assert np.allclose(chain.make_small(1, prepared), (frames[0] + frames[2]) / 2, atol=1e-6)
    assert chain.small == [pytest.approx(-10 * np.log10(np.mean(((frames[0] + frames[2]) / 2 - frames[1]) ** 2)), abs=1e-4)]
    with pytest.raises(InputError, match="needs frames 1 and 3"):
        chain.make_small(2, prepared)
    for words, message in (
        (["--methods", "nsrr"], "--nsrr: expected its weights"),
        (["--methods", "wgsl"], "--wgsl: expected where it was fetched to"),
        (["--methods", "network+rife"], r"frame 0 is not in .*; name its method before it"),
        (
            ["--methods", "nsrr", "--nsrr", str(tmp_path / "extranet")],
            "expected weights of python -m training.rivals.train DATA nsrr",
        ),
        (["--methods", "authors", "--authors", str(tmp_path / "nsrr")], "expected medieval.pth.tar"),
    ):
        with pytest.raises(InputError, match=message):
            run.main([options[0], options[1], "-o", str(tmp_path / "other"), "--rendered", "even", *words])


def test_no_accumulate_shows_the_networks_own_images(tmp_path):
    """By weights that are made for aliased input images are mixed, from the second frame on; with the option as by any others."""
    write_demo_sequence(tmp_path, 3, (16, 24))
    save(aliased := tmp_path / "aliased.safetensors", zeros(), {MADE_FOR: ALIASED})
    runs, words = [(aliased, []), (aliased, ["--no-accumulate"]), ("bilinear", [])], ["--rendered", "even", "--methods", NETWORK]
    for number, (weights, more) in enumerate(runs):
        out = ["-o", str(tmp_path / str(number)), "--weights", str(weights)]
        run.main([str(tmp_path / "frames"), str(tmp_path / "truth"), *out, *words, *more])
    folders = [tmp_path / str(number) / NETWORK for number in range(3)]
    mixed, alone, others = (np.stack([read_rgb(path) for path in sorted(folder.glob("*.exr"))]) for folder in folders)
    np.testing.assert_array_equal(alone, others)
    assert [bool((one != other).any()) for one, other in zip(mixed, alone, strict=True)] == [False, True, True]


def test_training_changes_crops_as_augment_says(data, tmp_path, monkeypatch):
    """With `none` a step sees the crops themselves; each other choice sees others, and ends with other weights."""
    seen, real = [], train.tensors
    monkeypatch.setattr(train, "tensors", lambda batch, device: seen.append(batch) or real(batch, device))
    monkeypatch.setattr(train, "batches", lambda data, name, side, *more, make=train.batches: make(data, name, 16, *more))
    for how in AUGMENTS:
        train.main([str(data), "extranet", "-o", str(tmp_path / how), "--steps", "1", "--batch", "2", "--augment", how])
    train.main([str(data), "extranet", "-o", str(tmp_path / "by itself"), "--steps", "1", "--batch", "2"])
    by = dict(zip((*AUGMENTS, "by itself"), seen, strict=True))
    shard = np.load(data / "analytic-00001-aliased" / "truth.npy").astype(np.float32)
    windows = np.lib.stride_tricks.sliding_window_view(shard, (32, 32), axis=(1, 2))  # (N, y, x, 3, 32, 32)

    def is_cut_out(truth):
        return bool((windows == truth).all(axis=(-3, -2, -1)).any())

    assert all(map(is_cut_out, by["none"].truth))
    assert not any(map(is_cut_out, (*by["all"].truth, *by["upright"].truth)))
    np.testing.assert_array_equal(by["by itself"].truth, by["all"].truth)
    assert len({(tmp_path / how).read_bytes() for how in AUGMENTS}) == len(AUGMENTS)


def test_the_authors_network_reads_light_and_the_sky_keeps_its_colour(tmp_path):
    """A network that passes the warped light on gives the warped picture: colour by base colour, times base colour."""
    write_demo_sequence(tmp_path, 6, (16, 24))
    files = open_sequence(tmp_path / "frames")
    curve = transfer("srgb")
    window = [display_frame.make_display_frame(files.load(number), curve, "scale") for number in range(6)]
    plain = prepare(display_frame.frame_inputs(window, (1, 3, 5))).color
    calls = {}

    def network(color, mask, features, history):
        calls.update(color=color, mask=mask, features=features, history=history)
        return color[:, 3:]

    image = authors.extrapolate(network, window, (1, 3, 5), files.load, curve)
    now = files.load(5)
    sky = ~np.isfinite(now.depth)
    assert image.shape == plain[..., :3].shape
    assert [calls[name].shape[1] for name in ("color", "mask", "features", "history")] == [6, 1, 6, 4]
    np.testing.assert_array_equal(image[sky], plain[..., :3][sky])
    assert (calls["features"][0, :3].numpy().transpose(1, 2, 0)[:16, :24][sky] == -1).all()
    flat = (now.base_color > 0.05).all(axis=-1) & ~sky
    assert np.median(np.abs(image - plain[..., :3])[flat]) < 0.05  # light is warped here, colour there


def test_a_missing_package_of_full_is_said_before_any_frame(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycvvdp", None)
    with pytest.raises(InputError, match=r"--full: pycvvdp is not installed: pip install cvvdp"):
        run.main([str(tmp_path / "none"), str(tmp_path / "none"), "-o", str(tmp_path / "out"), "--full"])


def test_an_upsampler_sees_motion_without_jitter(tmp_path):
    """A camera at rest whose picture is shifted: nothing moves."""
    write_demo_sequence(tmp_path, 3, (16, 24))
    files = open_sequence(tmp_path / "frames")
    offsets, frames_seen = {0: (0.25, -0.5), 1: (-0.25, 0.5), 2: (0.0, 0.0)}, []
    curve = transfer("srgb")
    frames = [display_frame.make_display_frame(files.load(number), curve, "scale") for number in range(3)]
    shift = [np.subtract(offsets[max(n - 1, 0)], offsets[n]).astype(np.float32) for n in range(3)]
    moved = [np.broadcast_to(s, frames[0].motion.shape) for s in shift]
    frames = [replace(f, motion=m, color=frames[0].color) for f, m in zip(frames, moved, strict=True)]

    def upsampler(frame):
        frames_seen.append(frame)
        return upsample_centres(frame.color)

    backend = jittered.JitteredBackend("some", upsampler, offsets, files.load, curve)
    for n, steps in enumerate([(0, 0, 0), (0, 1, 1), (0, 2, 2)]):
        backend.compute(frames[: n + 1], steps)
    assert [frame.first for frame in frames_seen] == [True, False, False]
    assert all(not frame.motion.any() for frame in frames_seen)
    assert [(frame.offset, frame.before) for frame in frames_seen[1:]] == [(offsets[1], offsets[0]), (offsets[2], offsets[1])]
    with pytest.raises(InputError, match="expected lines of frame,x,y"):
        jittered.read_offsets(files.path / "none.csv")


def test_nss_counts_to_the_bit():
    """TOSA's operators against sums of Python's integers."""
    random = np.random.default_rng(0)
    x, weight = random.integers(-128, 128, (5, 6, 3)), random.integers(-128, 128, (2, 3, 3, 3))
    result = nss.conv2d([[1, 0, 1, 0], 2, [1, 1], 1, False, x, weight, [7, 2**32 - 9], [128], 0])
    padded = np.pad(x + 128, ((1, 0), (1, 0), (0, 0)))
    assert result.shape == (2, 3, 2)
    for (j, i, channel), value in np.ndenumerate(result):
        patch = padded[2 * j : 2 * j + 3, 2 * i : 2 * i + 3]
        assert (
            value == sum(int(a) * int(b) for a, b in zip(patch.ravel(), weight[channel].ravel(), strict=True)) + (7, -9)[channel]
        )
    sums, multiplier, shift = np.array([[[-3, 5], [2**20, -(2**20)]]]), [2**30, 3 * 2**29], [31, 31]
    assert nss.rescale([True, 1, True, False, False, sums, multiplier, shift, 0, [2]]).tolist() == [[[1, 6], [127, -128]]]
    nearest = nss.resize([1, x, [4, 2, 4, 2], 2**32 - 1, 1])
    np.testing.assert_array_equal(nearest, x.repeat(2, axis=0).repeat(2, axis=1))
    table = [*range(129, 256), *range(129)]
    assert nss.OPERATORS[nss.TABLE]([np.array([-128, 0, 127]), [128, *table]]).tolist() == [-128, 0, 127]
    np.testing.assert_allclose(nss.tonemap_back(nss.tonemap(np.float32([[[0.1, 2.0, 7.0]]]))), [[[0.1, 2.0, 7.0]]], rtol=1e-5)


def test_nss_refuses_other_files(tmp_path):
    pytest.importorskip("vgfpy", reason="ai-ml-sdk-vgf-library is not installed")
    for size in (3, 5000):
        (tmp_path / "no.vgf").write_bytes(bytes(size))
        with pytest.raises(InputError, match="expected a VGF file"):
            nss.Graph(tmp_path / "no.vgf")


def test_nss_reads_between_pixels():
    """A kernel of Catmull and Rom passes through the pixels and follows a ramp along each axis."""
    y, x = np.indices((8, 9), np.float32)
    ramp = np.stack([x, 2 * y, x + y], axis=-1)
    inner = (slice(2, -3), slice(2, -3))
    for reader in (nss.read, nss.read_sharply):
        np.testing.assert_allclose(reader(ramp, x, y)[inner], ramp[inner], atol=1e-5)
        np.testing.assert_allclose(reader(ramp, x + 0.25, y)[inner], (ramp + np.float32([0.25, 0, 0.25]))[inner], atol=1e-5)
        np.testing.assert_allclose(reader(ramp, x, y + 0.5)[inner], (ramp + np.float32([0, 1, 0.5]))[inner], atol=1e-5)
    depth, across, down = nss.nearest_depth(np.float32([[5, 5, 5], [5, 5, 1], [5, 5, 5]]))
    assert depth[0, 1] == 1
    assert (across[0, 1], down[0, 1]) == (1, 1)
    assert (across[0, 0], down[0, 0]) == (0, 0)


def test_shaders_are_put_together_from_a_checkout(tmp_path):
    shaders = tmp_path / "src" / "shaders"
    shaders.mkdir(parents=True)
    common = "export const WGSL_A = /* wgsl */ `A`;\nexport const WGSL_B = /* wgsl */ `B`;\n"
    (shaders / "common.ts").write_text(common)
    own = "assembleShader(\n WGSL_B,\n /* wgsl */ `var d : texture_depth_2d; let x = textureLoad(sceneDepth, p, 0);`,\n);"
    (shaders / "reconstruct.ts").write_text(own)
    text = wgsl_upscaler.shader(tmp_path, "reconstruct")
    assert text == "B\nvar d : texture_2d<f32>; let x = textureLoad(sceneDepth, p, 0).r;"
    with pytest.raises(InputError, match=r"expected a checkout of github\.com/pmndrs/upscaler"):
        wgsl_upscaler.shader(tmp_path / "elsewhere", "reconstruct")


def test_multiply_adds_are_counted(capsys):
    cost.main(["--size", "32x32", "--rows", "stss", "extranet", "--engines", "pytorch", "--repeat", "1", "--threads", "1"])
    output = capsys.readouterr().out
    assert "stss: 0.417 M parameters" in output
    assert "extranet, pytorch:" in output
