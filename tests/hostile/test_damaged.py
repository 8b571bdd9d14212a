"""Damaged files of every kind: each is read, or refused in one line. ``make fuzz`` draws more of them."""

import shutil
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from conformance.protocol.job_folder import write_job
from conformance.protocol.program_port import smallest_case
from stss.images.read_write import write_channels, write_rgb
from stss.sequence.profiles import load_profile
from stss.weights.file import save
from stss_ref.weights import zeros
from tests.app.conftest import frame_channels
from tests.hostile.cases import call

WORDS = [
    *(struct.pack(f"<{kind}", n) for kind, n in zip("IIIQQ", (0, 2**31, 2**32 - 1, 2**63, 2**64 - 1), strict=True)),
    *(struct.pack(">I", n) for n in (2**14, 2**31 - 1)),
    *(struct.pack("<f", x) for x in (1e38, np.inf, np.nan)),
    b"\x1b[2J", b"\xff\xfe", b"\xe2\x80\xae", b"\r\n", b"\0", b"[" * 2000, b"{a=" * 500, b"a." * 500, b"9" * 401, b"1e999", b"-0",
    b"nan", b"[[x]]", b'"""', b"[]", b"{}", b'"\\ud800"', b'"F64"', b"null", b"chlist\0", b"tiledesc\0", b"IHDR", b"zTXt", b"<f8", b"|O",
]  # fmt: skip
"""Bytes that may confuse a parser."""


@st.composite
def damaged(draw, whole, head):
    """Bytes of ``whole`` with up to four places changed, left out or put in, most of them in the first ``head``."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.one_of(st.integers(0, head), st.integers(0, len(whole))))
        length = draw(st.sampled_from((0, 1, 4, 64, len(whole))))
        data[at : at + length] = draw(st.one_of(st.binary(max_size=8), st.sampled_from(WORDS)))
    return bytes(data)


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """By kind: the file, how many bytes its head has, the command that reads it, and its statuses."""
    folder = tmp_path_factory.mktemp("whole")
    for name in ("in", "out", "truth", "empty"):
        (folder / name).mkdir()
    for number in (1, 2, 3):
        write_channels(folder / "in" / f"a.{number}.exr", frame_channels(number, (4, 6)), half=("R",))
    for name in ("out", "truth"):
        write_rgb(folder / name / "frame.1.png", np.linspace(0, 1, 576).reshape(12, 16, 3), metadata={"stss:kind": "SF"})
    shutil.copy(load_profile("stss").path, folder / "mine.toml")
    save(folder / "w.safetensors", zeros(), {"made": "here"})
    write_job(folder / "job", [smallest_case("warp")])
    return {
        "exr": (folder / "in" / "a.2.exr", 900, ("check", folder / "in"), {0, 1, 2}),
        "png": (folder / "out" / "frame.1.png", 60, ("compare", folder / "out", folder / "truth"), {0, 2}),
        "profile": (folder / "mine.toml", 500, ("check", folder / "empty", "--profile", folder / "mine.toml"), {2}),
        "weights": (folder / "w.safetensors", 8000, ("weights", "inspect", folder / "w.safetensors"), {0, 2}),
        "job": (folder / "job" / "0000" / "in" / "motion.npy", 128, ("port", folder / "job"), {0, 2}),
        "stage": (folder / "job" / "0000" / "stage", 4, ("port", folder / "job"), {0, 2}),
    }


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
@pytest.mark.parametrize("kind", ["exr", "png", "profile", "weights", "job", "stage"])
def test_no_damaged_file_does_harm(places, kind, data):
    """No traceback, no warning, no hang."""
    path, head, command, statuses = places[kind]
    whole = path.read_bytes()
    path.write_bytes(data.draw(damaged(whole, head)))
    try:
        process = call(*command)
    finally:
        path.write_bytes(whole)
    assert process.returncode in statuses, process.stderr
    assert len(process.stderr.splitlines()) == (process.returncode == 2 and not process.stdout), process.stderr
    assert all(line.isprintable() for line in [*process.stderr.splitlines(), *process.stdout.splitlines()])
