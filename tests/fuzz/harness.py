"""Shared by the fuzzers: call ``stss`` in this process under a watchdog, mutate bytes, keep time.

A case is right if it ends in time, with a status that is allowed, without a traceback, a warning, or anything on standard
error but one printable line.
"""

import contextlib
import faulthandler
import io
import os
import random
import re
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path

from stss.cli.main import main

_STDERR = os.dup(2)
"""The process's own standard error, for its last message: a later redirection does not change it."""
CASE_SECONDS = 30
"""Most seconds of a case, on a busy machine; a case usually takes a hundredth of a second."""


@dataclass(frozen=True)
class Result:
    """The result of a call, as of ``subprocess.run``."""

    returncode: int
    stdout: str
    stderr: str


class HangError(BaseException):
    """A case hangs. No ``Exception``, since the watched code must not catch it."""


@contextlib.contextmanager
def watchdog(seconds=CASE_SECONDS):
    """Raise HangError after ``seconds``; if native code does not return, end the process soon after."""

    def expired(*_):
        raise HangError(f"no end in {seconds} s")

    before = signal.signal(signal.SIGALRM, expired)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    faulthandler.dump_traceback_later(3 * seconds, exit=True, file=_STDERR)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGALRM, before)


def call(*arguments, seconds=CASE_SECONDS):
    """Call ``stss`` in this process; returns its status and all output, also of native libraries. Warnings are errors."""
    out, err = io.TextIOWrapper(io.BytesIO(), "utf-8"), io.TextIOWrapper(io.BytesIO(), "utf-8")
    with _native_errors() as native, warnings.catch_warnings(), watchdog(seconds), contextlib.ExitStack() as stack:
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", module=r"colour\.")  # see stss.color
        stack.callback(setattr, sys, "argv", sys.argv)
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        sys.argv = ["stss", *map(os.fsdecode, map(_word, arguments))]
        try:
            main()
            status = 0
        except SystemExit as ended:
            status = ended.code
    out.flush(), err.flush()
    return Result(status, out.buffer.getvalue().decode(), err.buffer.getvalue().decode() + native.getvalue())


def judge(arguments, statuses, seconds=CASE_SECONDS, allowed="\n"):
    """Call ``stss``; raise AssertionError unless the case is right. Lines of a native library may begin with ``allowed``."""
    try:
        result = call(*arguments, seconds=seconds)
    except (Exception, HangError) as error:
        raise AssertionError("".join(traceback.format_exception(error))) from None
    assert result.returncode in statuses, f"status {result.returncode}: {result.stderr}"
    lines = [line for line in result.stderr.splitlines() if not line.startswith(allowed)]
    assert len(lines) == (result.returncode == 2 and not result.stdout), result.stderr
    assert all(line.isprintable() for line in [*lines, *result.stdout.splitlines()]), (result.stderr, result.stdout)
    return result


def fuzz(seed, seconds, make, check):
    """Cases until the time is over, one at least.

    Args:
        seed: of the first case; each has its own generator, so that case N can be had again alone.
        seconds: to go on.
        make: generator -> the file's bytes.
        check: handed a folder and the bytes; raises AssertionError.

    Returns:
        How many cases; AssertionError names the seed, the case, and a file that holds it.
    """
    end, count = time.monotonic() + seconds, 0
    with tempfile.TemporaryDirectory(prefix="stss-fuzz-") as folder:
        while count == 0 or time.monotonic() < end:
            data = make(random.Random(f"{seed} {count}"))
            try:
                check(Path(folder), data)
            except AssertionError as error:
                kept = Path(tempfile.mkdtemp(prefix="stss-fuzz-case-")) / "case"
                kept.write_bytes(data)
                raise AssertionError(f"seed {seed}, case {count}, kept as {kept}: {error}") from None
            count += 1
    return count


def mutated(random_, data, words=()):
    """Bytes with a few faults: changed, doubled, left out, exchanged, cut, or replaced by one of ``words``."""
    data = bytearray(data)
    for _ in range(random_.choice((1, 1, 1, 2, 4, 16))):
        if not data:
            break
        a = random_.randrange(len(data))
        b = min(len(data), a + random_.choice((1, 1, 2, 4, 8, 64, 512)))
        match random_.randrange(8):
            case 0:
                data[a] ^= 1 << random_.randrange(8)
            case 1:
                data[a:b] = random_.randbytes(b - a)
            case 2:
                del data[a:b]
            case 3:
                data[a:a] = data[a:b] * random_.choice((1, 2, 50))
            case 4:
                data[a:b] = random_.choice((b"\0", b"\xff", b"\x80", b"\x7f")) * (b - a)
            case 5:
                c = random_.randrange(len(data))
                data[a:b] = data[c : c + b - a]
            case 6 if random_.random() < 0.2:
                del data[a:]
            case _ if words:
                word = random_.choice(words)
                data[a : a + random_.choice((0, len(word)))] = word
    return bytes(data)


def exchanged(random_, data, pattern, words):
    """Bytes with one match of ``pattern`` replaced by one of ``words``: faults that a parser accepts."""
    found = random_.choice(list(re.finditer(pattern, data)))
    return data[: found.start()] + random_.choice(words) + data[found.end() :]


@contextlib.contextmanager
def _native_errors():
    """Collect standard error of native code, which bypasses Python; the buffer has it as text after the block."""
    text = io.StringIO()
    if threading.current_thread() is not threading.main_thread():
        yield text
        return
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield text
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            text.write(file.read().decode(errors="replace"))


def _word(argument):
    return argument if isinstance(argument, (str, bytes, os.PathLike)) else str(argument)
