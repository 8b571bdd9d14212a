"""``--resume`` keeps no frame that another option's value would have made: a table of all options of ``stss run``."""

import numpy as np
import pytest
from click.testing import CliRunner

from conformance.scenes import DEMO, render
from stss.cli.main import stss
from stss.frames.backends import ReferenceBackend
from stss.images.headers import read_header
from stss.images.read_write import read_channels, write_channels
from stss.sequence.profiles import load_profile
from stss.weights.file import save
from stss_ref.weights import Weights, random
from tests.tiers import every

SIZE, COUNT = (16, 24), 4
OPTIONS = {
    "--profile": "mine.toml",
    "--camera": "camera.csv",
    "--metallic": "0.25",
    "--roughness": "0.25",
    "--background": "camera",
    "--static": "camera",
    "--weights": "random.safetensors",
    "--rendered": "odd",
    "--cuts": "2",
    "--also": "extra",
    "--transfer": "none",
    "--depth": "clip",
    "--format": "png",
    "--accumulate": "",  # takes none
}
"""An option -> a value that changes a file of the frames below; with `NO_FILE` all options of the command."""
NO_FILE = {
    "--out", "--frames", "--resume", "--overwrite", "--cluster", "--keep-going", "--memory-limit",  # no file's content
    "--non-finite",  # refused, or masked: no value makes two files of one frame
    "--backend", "--device", "--precision", "--skip",  # the backend's name, which is in every file, or no bit
}  # fmt: skip


def run(*words):
    result = CliRunner().invoke(stss, ["run", "frames", *words, "--backend", "ref"])
    assert result.exit_code == 0, result.output
    return result.output


def pixels(folder):
    """The content of the files of a run, without their metadata."""
    return {
        str(path.relative_to(folder)): {
            name: plane.tobytes() for name, plane in read_channels(path, read_header(path).channels).items()
        }
        for path in sorted(folder.rglob("*.*"))
        if path.suffix in (".exr", ".png")
    }


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shot")
    (folder / "frames").mkdir()
    for number in range(COUNT):
        low, channels = render(DEMO, number, *SIZE), {}
        missed = np.isinf(low.depth)
        planes = {"motion": np.where(missed[..., None], 0, low.motion), "depth": np.where(missed, 0, low.depth)}
        for buffer, (names, *_) in load_profile("stss").channels.items():
            values = np.atleast_3d(planes.get(buffer, getattr(low, buffer)))
            if buffer not in ("metallic", "roughness", "nov"):
                channels |= {name: np.nan_to_num(values[..., i], posinf=1e7) for i, name in enumerate(names)}
        write_channels(folder / "frames" / f"a.{number:04d}.exr", channels | {"extra.Y": channels["R"] / 2})
    (folder / "mine.toml").write_text('base = "stss"\n[motion]\nscale = [2.0, 2.0]\n')
    (folder / "camera.csv").write_text("frame,x,y,z\n" + "".join(f"{n},1e5,0,0\n" for n in range(COUNT)))
    save(folder / "random.safetensors", Weights(random(0), hole_test="paper"), {})
    return folder


def test_every_option_is_in_the_table():
    options = {name for each in stss.get_command(None, "run").params for name in each.opts if name.startswith("--")}
    assert options == OPTIONS.keys() | NO_FILE, (
        "a new option of stss run: with a value that changes a file, or as one that cannot"
    )


@pytest.mark.parametrize("option", every(3, OPTIONS))
def test_resume_makes_anew_what_another_value_made(shot, tmp_path, monkeypatch, option):
    monkeypatch.chdir(shot)
    weights = "bilinear" if option == "--weights" else "random.safetensors"
    base = ["--metallic", "0", "--roughness", "0.5", "--weights", weights]
    other = [*base, option, *OPTIONS[option].split()]
    run("-o", str(tmp_path / "old"), *base)
    before = pixels(tmp_path / "old")
    run("-o", str(tmp_path / "new"), *other)
    run("-o", str(tmp_path / "old"), *other, "--resume")
    new, old = pixels(tmp_path / "new"), pixels(tmp_path / "old")
    assert new != before, f"{option} {OPTIONS[option]} changes nothing: this test could not fail"
    assert new == {name: old[name] for name in new}


def test_resume_says_why_frames_are_made_again(shot, tmp_path, monkeypatch):
    monkeypatch.chdir(shot)
    base = ["-o", str(tmp_path / "out"), "--weights", "random.safetensors", "--metallic", "0", "--roughness", "0.5"]
    run(*base, "--frames", "0:1")
    assert "--resume: " not in run(*base, "--frames", "0:1", "--resume")  # the same settings
    assert "--resume: " not in run(*base, "--frames", "2:3", "--transfer", "none", "--resume")  # frames 0 and 1 stay as they are
    for value, words in (("none", "transfer srgb, not none"), ("srgb", "transfer none, not srgb")):
        lines = run(*base, "--transfer", value, "--resume").splitlines()
        assert f"--resume: {tmp_path}/out/frame.0000.exr: {words}; such frames are made again" in lines
    assert "frame.0000.exr: format exr, not png;" in run(*base, "--format", "png", "--resume")
    monkeypatch.setattr(ReferenceBackend, "name", "another")
    assert "frame.0000.exr: backend ref, not another;" in run(*base, "--resume")
