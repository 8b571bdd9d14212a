"""The frames of a sequence choose the weights, once, and every command says which."""

import json
from dataclasses import replace

import numpy as np
import pytest

from conformance.scenes import DEMO, render
from stss.check_sequence.report import check
from stss.demo import demo_path, frame_channels
from stss.images.headers import read_header
from stss.images.read_write import read_channels, write_channels
from stss.sequence.antialiasing import judge_sampling
from stss.sequence.choose_weights import AUTO, choose_weights
from stss.sequence.reader import SequenceOptions, open_sequence
from stss.weights.file import load
from stss_ground.errors import InputError
from tests.app.conftest import write_parts

SIZE = (72, 128)


def mean_normals(number):
    """As a path tracer writes them: means over the pixel."""
    fine = render(DEMO, number, 3 * SIZE[0], 3 * SIZE[1]).normal
    return fine.reshape(SIZE[0], 3, SIZE[1], 3, 3).mean(axis=(1, 3))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Sequences of one frame with a colour and one without: aliased, an antialiased colour, an antialiased G-buffer as well."""
    root = tmp_path_factory.mktemp("sampling")
    for kind, samples in (("aliased", 1), ("color", 9), ("all", 9)):
        (root / kind).mkdir()
        for number in range(2):
            frame = render(DEMO, number, *SIZE, samples=samples)
            if kind == "all":
                frame = replace(frame, normal=mean_normals(number))
            write_channels(demo_path(root / kind, number), frame_channels(frame, rendered=number == 0))
    return root


@pytest.mark.parametrize(
    ("kind", "antialiased", "reason"),
    [
        ("aliased", False, "edges have a colour in between"),
        ("color", True, "edges have a colour in between"),
        ("all", True, "mixtures"),
    ],
)
def test_frames_say_how_they_were_sampled(rendered, kind, antialiased, reason):
    sequence, lines = open_sequence(rendered / kind, "stss"), []
    sampling, name = judge_sampling(sequence), "antialiased" if antialiased else "realtime"
    assert sampling.antialiased == antialiased
    assert reason in sampling.reason
    loaded = choose_weights(AUTO, sequence, lines.append)
    assert loaded.label == f"{name} {load(name).identity}"
    assert lines[0].startswith(f"weights: {name} (")
    report = check(rendered / kind, SequenceOptions("stss"))
    assert any(f"stss run takes the weights {name}" in finding.text for finding in report.findings)
    assert json.loads(report.to_json())["sampling"]["antialiased"] is antialiased


def test_edges_are_seen_along_all_axes(tmp_path):
    """The verdict does not depend on the names of the axes."""
    reasons = set()
    for turned in range(3):
        (tmp_path / str(turned)).mkdir()
        for number in range(2):
            frame = render(DEMO, number, *SIZE, samples=9)
            frame = replace(frame, normal=np.roll(frame.normal, turned, axis=-1))
            write_channels(demo_path(tmp_path / str(turned), number), frame_channels(frame, rendered=number == 0))
        reasons.add(judge_sampling(open_sequence(tmp_path / str(turned), "stss")).reason)
    assert len(reasons) == 1


@pytest.mark.parametrize("compression", ["zip", "pxr24", "dwaa:45", "dwab:200", "dwaa"])
@pytest.mark.parametrize("kind", ["aliased", "all"])
def test_mixed_normals_are_seen_behind_lossy_compression(rendered, tmp_path, kind, compression):
    """Colours alone do not decide: those of the antialiased frames are aliased here."""
    for number in range(2):
        path, colors = demo_path(rendered / kind, number), demo_path(rendered / "aliased", number)
        channels = {
            **read_channels(path, read_header(path).channels),
            **read_channels(colors, [name for name in read_header(colors).channels if name in "RGB"]),
        }
        pixels = np.stack([*channels.values()], axis=-1)
        write_parts(demo_path(tmp_path, number), (pixels, (*channels,), {"compression": (compression,)}))
    assert judge_sampling(open_sequence(tmp_path, "stss")).antialiased is (kind == "all")


@pytest.mark.parametrize(("beauty", "others"), [("zip", "dwaa:1000"), ("dwaa:45", "zip")])
def test_each_part_has_its_own_compression(rendered, tmp_path, beauty, others):
    """What it changed in the normals is no antialiasing; what it changed in the colour alone is no warning."""
    for number in range(2):
        channels = read_channels(
            demo_path(rendered / "aliased", number), read_header(demo_path(rendered / "aliased", number)).channels
        )
        color, rest = ([n for n in channels if (n in "RGB") == of] for of in (True, False))
        parts = [
            (np.stack([channels[n] for n in of], axis=-1), of, {"compression": (kind,)})
            for of, kind in ((color, beauty), (rest, others))
            if of
        ]
        write_parts(demo_path(tmp_path, number), *parts)
    report = check(tmp_path, SequenceOptions("stss"))
    lossy = [finding.text for finding in report.findings if finding.level == "warning" and "compression" in finding.text]
    if others == "zip":
        assert not lossy
    else:
        (text,) = lossy
        assert text.startswith("dwaa compression changes motion, normal, position, base_color;")
    assert not judge_sampling(open_sequence(tmp_path, "stss")).antialiased
    assert {row["compression"] for row in report.tables["channels"].values()} == {"dwaa", "zip"}


def test_where_nothing_is_to_be_chosen_nothing_is_said(rendered):
    """A name overrides the frames, and a method without a network needs no weights; a wrong name is still an error."""
    lines, sequence = [], open_sequence(rendered / "aliased", "stss")
    assert choose_weights("antialiased", sequence, lines.append).source == "antialiased"
    assert choose_weights(AUTO, sequence, lines.append, needed=False).source == "bilinear"
    assert lines == []
    with pytest.raises(InputError):
        choose_weights("bicubic", sequence, lines.append, needed=False)


def test_a_sky_with_a_depth_mixes_nothing(write_frames):
    """The far plane's, or a dome's: its normals are 0, not mixtures."""

    def change(number, channels):
        channels["depth.Z"][:8] = 8e4
        for axis in "XYZ":
            channels[f"normal.{axis}"][:8] = 0

    sampling = judge_sampling(open_sequence(write_frames([1, 2], change=change), "stss"))
    assert "mixtures" not in sampling.reason


def test_a_part_of_a_sequence_gets_the_weights_of_the_whole(rendered, tmp_path):
    """Frames in which nothing tells, at the start, change nothing: the last rendered frame is looked at as well."""
    for number in range(4):
        channels = frame_channels(render(DEMO, number, *SIZE, samples=9), rendered=number % 2 == 0)
        if number == 0:
            channels |= {name: np.zeros(SIZE, np.float32) for name in "RGB"}
        write_channels(demo_path(tmp_path, number), channels)
    assert judge_sampling(open_sequence(tmp_path, "stss")).antialiased


def test_where_nothing_tells_frames_count_as_an_engine_gives_them(write_frames):
    sampling = judge_sampling(open_sequence(write_frames([1, 2, 3]), "stss"))
    assert not sampling.antialiased
    assert "only 0 edges" in sampling.reason
