"""Every command on a page runs unchanged, on small frames; or it is listed here with the reason why not."""

import re
import shlex
import shutil
from pathlib import Path

import click
import numpy as np
import pytest

from conformance.scenes import DEMO, render
from stss.cli.main import stss
from stss.demo import write_demo_sequence
from stss.images.read_write import write_channels
from stss.sequence.conventions import motion_in_pixels
from stss.sequence.profiles import load_profile
from stss.weights.file import SHIPPED
from tests.app.docs.test_page_code import PAGES, ROOT
from tests.hostile.cases import call
from tests.tiers import thorough

BLOCK = re.compile(r"^( *)```(?:sh|bash)\n(.*?)^ *```", re.M | re.S)
CELL = re.compile(r"`(stss [a-z][^`]*)`")
NOT_RUN = {
    r"make( [a-z-]+)?$": "installs; each target is in the Makefile, which another test here looks up; CI runs demo, check and test",
    r"(.*/)?(pip|uvx|npm|apt|apt-get|git|ln|podman|docker) ": "installs or fetches",
    r"\. \.venv/bin/activate": "for the shell of the reader",
    r"python (-m training|training/)|[ct]=|[RSTU]=|\$[RSTU] |for |done$|case |name=": "hours, and PyTorch; tests/training parses them",
    r"python render\.py": "Blender, and an older commit",
    r"python blender/measure_saving\.py": "Blender; tests/app/blender/test_blender_extension.py runs it where bpy is",
    r"blender --(command|background)": "Blender's program; tests/app/blender/test_blender_extension.py does the same in bpy",
    r"python blender/build.py": "fetches packages; tests/app/blender/test_blender_extension.py runs it where bpy is",
    r"python examples/webgpu/page.py": "tests/app/examples/test_webgpu_page.py runs it",
    r"python -m pytest .*--port": "a port of the reader's; tests/meta runs the suite so",
    r"stss conform ": "a port of the reader's; tests/app/port/test_port.py and test_examples.py run some",
    r"stss run .* --cluster tcp:": "a cluster; tests/app/cluster/test_cluster.py makes one",
    r"ffmpeg ": "a program of others",
    r"openjd run ": "tests/app/cluster/test_farm.py runs it as it stands",
    r"stss (bench|tune|stress|gpu-report)\b": "minutes, a GPU, or PyTorch; tests of their own run each of them small",
    r"stss weights import checkpoints/": "the authors' checkpoints; tests/app/weights imports one of their kind",
    r"stss methods .*arena": "weights of others; tests/app/lab/test_without_part.py runs it small",
    r"stss demo$": "half a minute; `make demo`, and tests/app/demo/test_demo.py small",
}
"""The beginning of a line -> the reason not to run it here."""
FRAMES = ("frames", "shot", "lr", "LR", "SEQUENCE", "FRAMES")
TRUTH = ("truth", "full", "hr", "HR", "TRUTH")
SIZE, COUNT = (16, 24), 16


def blocks():
    """(page, its lines) of every block of commands."""
    for page in PAGES:
        for block in BLOCK.finditer(page.read_text(encoding="utf-8")):
            lines = [re.split(r"\s#\s", line)[0].strip() for line in block[2].replace("\\\n", " ").splitlines()]
            yield str(page.relative_to(ROOT)), [line for line in lines if line]


def reason(line):
    return next((why for pattern, why in NOT_RUN.items() if re.match(pattern, line)), None)


def cells():
    """(page, command) of those in running text that name an output."""
    for page in PAGES:
        for cell in CELL.finditer(BLOCK.sub("", page.read_text(encoding="utf-8")).replace("\n", " ")):
            words = shlex.split(cell[1])
            if len(words) > 2 and words[1] in stss.list_commands(None) and "-o" in words:
                yield str(page.relative_to(ROOT)), cell[1]


def parse(words):
    """Parse, without running anything."""
    group, command = click.Context(stss, info_name="stss"), stss
    while isinstance(command, click.Group):
        subcommand = command.get_command(group, words[0])
        if subcommand is None:
            raise click.UsageError(f"no command {words[0]}")
        command, words = subcommand, words[1:]
    command.make_context(command.name, list(words), parent=group)


def write_as(folder, name):
    """The demo's frames, with the names and in the conventions of a profile."""
    profile = load_profile(name)
    one = motion_in_pixels(np.ones((*SIZE, 2)), profile.motion) - motion_in_pixels(np.zeros((*SIZE, 2)), profile.motion)
    for number in range(COUNT):
        low = render(DEMO, number, *SIZE, samples=9)
        planes = {
            "motion": low.motion / one + np.array(profile.motion.bias),
            "position": low.position * profile.units_per_cm,
            "depth": np.minimum(low.depth, 1e10),
        }
        channels = {}
        for buffer, (names, *_) in profile.channels.items():
            if buffer in {*profile.files, *profile.constants}:
                continue
            values = np.atleast_3d(planes.get(buffer, getattr(low, buffer)))
            if buffer != "color" or name == "unreal-mrq" or number % 2 == 0:
                channels |= {full.replace("{layer}", "ViewLayer"): values[..., i] for i, full in enumerate(names)}
        folder.mkdir(parents=True, exist_ok=True)
        write_channels(folder / f"demo.{number:04d}.exr", channels)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """Folders of frames by profile, their truth, and what was made of them; weights and tables."""
    folder = tmp_path_factory.mktemp("pages")
    write_demo_sequence(folder, COUNT, SIZE)
    (folder / "frames").rename(folder / "stss")
    for name in ("blender", "unreal-mrq", "mitsuba"):
        write_as(folder / name, name)
    assert not call("run", folder / "stss", "-o", folder / "made", "--weights", "bilinear", "--backend", "ref").returncode
    return folder


def provide(prepared, words):
    """Put the inputs of a command into place, and remove its outputs."""
    profile = words[words.index("--profile") + 1] if "--profile" in words else "stss"
    profile = "stss" if profile == "mine.toml" else profile
    for flag, word in zip(["", *words], words, strict=False):
        path = Path(word)
        if flag in ("-o", "--out"):
            shutil.rmtree(path, ignore_errors=True)
        elif path.suffix == ".csv":
            path.write_text("frame,x,y,z\n" + "".join(f"{n},0,0,0\n" for n in range(COUNT)))
        elif path.suffix == ".toml":
            shutil.copy(load_profile("stss").path, path)
        elif path.suffix == ".safetensors" and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(SHIPPED["realtime"], path)
        elif path.name in FRAMES + TRUTH and not path.exists():
            shutil.copytree(prepared / ("truth" if path.name in TRUTH else profile), path)
        elif flag == "--with" and not path.exists():
            shutil.copytree(prepared / "truth", path)  # frames of the reader's program
        elif words[0] == "compare" and path.name == "out" and not path.exists():
            shutil.copytree(prepared / "made", path)


RUN = [(page, commands) for page, lines in blocks() if (commands := [line for line in lines if reason(line) is None])]


OFTEN = [block if block[0] == "README.md" else thorough(*block) for block in RUN]
"""Each command takes a process of one to two seconds; all are parsed on every commit."""


@pytest.mark.parametrize(("page", "lines"), OFTEN, ids=lambda value: value if isinstance(value, str) else value[0])
def test_commands_run_as_they_stand(page, lines, device, request, prepared, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line in lines:
        name, *words = shlex.split(line)
        assert name == "stss", f"{page}: {line}: expected stss, or a reason in NOT_RUN"
        if "arena.pkl" in words:
            shutil.copy(request.getfixturevalue("reference_data") / "checkpoints" / "arena.pkl", ".")
        provide(prepared, words)
        process = call(*words, seconds=300)
        if process.returncode == 2 and "pip install" in process.stderr and {"--flip", "--vmaf"} & {*words}:
            continue  # the extra is not installed: its line says so
        assert process.returncode in ((0, 1) if words[0] == "check" else (0,)), f"{page}: {line}: {process.stderr}"


def test_all_commands_are_at_least_commands():
    for page, lines in blocks():
        for line in lines:
            if line.startswith("stss "):
                check_words(page, line)
            if match := re.match(r"make ([a-z-]+)", line):
                assert re.search(rf"^([a-z -]* )?{match[1]}( [a-z -]*)?:", (ROOT / "Makefile").read_text(), re.M), (
                    f"{page}: {line}"
                )
    for page, line in cells():
        check_words(page, line)


def check_words(page, line):
    try:
        parse(shlex.split(line)[1:])
    except click.exceptions.Exit:
        pass
    except click.ClickException as error:
        pytest.fail(f"{page}: {line}: {error.format_message()}")


def test_every_reason_is_needed():
    lines = [line for _, lines in blocks() for line in lines]
    for pattern in NOT_RUN:
        assert any(re.match(pattern, line) for line in lines), pattern
