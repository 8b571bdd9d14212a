"""What every hostile test needs: ``stss`` as a user types it, and what a refusal looks like."""

import os
import subprocess
import sys


def stss(*arguments, cwd=None, env=None, timeout=120, **more):
    """Run ``stss``; ``env`` is added to the environment."""
    command = [sys.executable, "-m", "stss", *map(os.fspath, map(_text, arguments))]
    environment = {**os.environ, **(env or {})}
    return subprocess.run(
        command, capture_output=True, text=True, errors="replace", timeout=timeout, cwd=cwd, env=environment, check=False, **more
    )


def refused(result, *words):
    """One line on stderr that holds all of ``words``, status 2, no traceback, nothing unprintable."""
    assert result.returncode == 2, result.stderr
    lines = [line for line in result.stderr.strip().splitlines() if not line.startswith(("first start: ", "weights: "))]
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("stss: ")
    assert lines[0].isprintable(), lines[0]
    for word in words:
        assert str(word) in lines[0], lines[0]


def _text(argument):
    return argument if isinstance(argument, (str, bytes, os.PathLike)) else str(argument)
