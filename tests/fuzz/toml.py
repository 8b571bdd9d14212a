"""Fuzz ``stss check`` with damaged profiles, and the reader of tile sizes with damaged rows."""

from stss.sequence.profiles import load_profile, profile_names
from stss_cl.device.tuning import BUILT_IN, built_in_rows
from stss_ground.errors import DeviceError
from tests.fuzz.harness import HangError, exchanged, fuzz, judge, mutated, watchdog

TUNING = b"# tuning\n"
WORDS = [
    b"9" * 401, b"0x" + b"f" * 5000, b"1e999", b"-0", b"nan", b"-inf", b"1979-05-27", b"true", b"[" * 2000, b"{a=" * 500, b"a." * 500,
    b"[[x]]", b"[motion]", b'"""', b"'''", b'"\\u001b[2J"', b'"\\ud800"', b"\xff", b"\x1b", b"\0", b"\r", b"\n", b" = ", b"[]", b"{}",
    b'name = "x"', b"[channels]", b"1_0", b"\xe2\x80\xae", b'""',
]  # fmt: skip


def make(random):
    """A built-in profile or the built-in rows, damaged."""
    name = random.choice((*profile_names(), "tuning"))
    whole = TUNING + BUILT_IN.read_bytes() if name == "tuning" else load_profile(name).path.read_bytes()
    if random.random() < 0.5:
        return exchanged(random, whole, rb"(?<== )[^,}#\n]+", WORDS)
    return whole[: len(TUNING)] + mutated(random, whole[len(TUNING) :], WORDS)


def check(folder, data):
    """Read damaged rows, or call ``stss check`` with a damaged profile on an empty folder, where its status is always 2."""
    path = folder / "case.toml"
    path.write_bytes(data)
    if data.startswith(TUNING):
        _check_rows(path)
    else:
        (folder / "empty").mkdir(exist_ok=True)
        judge(["check", folder / "empty", "--profile", path], {2})


def _check_rows(path):
    try:
        with watchdog():
            built_in_rows(path)
    except DeviceError:
        return
    except (Exception, HangError) as error:
        raise AssertionError(f"{type(error).__name__}: {error}") from error


def run(seed: int, seconds: float) -> int:
    """Run the fuzzer; returns the number of cases, or raises AssertionError with seed and case if one is wrong."""
    return fuzz(seed, seconds, make, check)
