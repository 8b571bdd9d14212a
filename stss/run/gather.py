# SPDX-License-Identifier: MIT
"""Put the parts of a run, each written by another process into a folder of its own, into one folder."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from stss.run.job import REFUSAL, folder_of
from stss_ground.errors import InputError
from stss_ground.output.apart import require_places
from stss_ground.output.folder import SUMS, OutputFolder
from stss_ground.output.write_whole import tell_errors
from stss_ground.progress import Track


def gather(parts: Path, out: Path, sequence: Path | None = None, *, overwrite: bool = False, track: Track = iter) -> int:
    """Move the files of all parts into one folder, as one run would have left it. What was interrupted can be repeated.

    Args:
        parts: holds a folder for each part.
        out: the folder to write to; the rules for a run's folder hold.
        sequence: the folder or pattern of the frames that the parts were made from: nothing is written to it.
        overwrite: replace the files of an earlier run.
        track: may show how many parts are looked at, and then moved.

    Returns:
        The number of parts.

    Raises:
        InputError: there is no part, a file of one is not as its list says, two parts differ in a file, a process writes to one, or
            ``out`` may not be written to.
    """
    folders = sorted(path for path in parts.iterdir() if path.is_dir()) if parts.is_dir() else []
    if not folders:
        raise InputError(f"{parts}: expected a folder with a folder for each part of a run")
    target = folder_of(out)
    inputs = [path for folder in folders for path in folder_of(folder).present()]
    if sequence is not None:
        frames = sequence if sequence.is_dir() else sequence.parent
        with tell_errors(frames):
            inputs += [path for path in frames.iterdir() if path.is_file()]
    require_places(folders=[target], inputs=inputs)
    with target.open(refusal=None):
        sums = _checked(folders, target, track)
        if not overwrite and any(sums.get(name) != digest for name, digest in target.sums().items()):
            raise InputError(f"{out}: {REFUSAL}")
        for folder in map(folders.__getitem__, track(range(len(folders)))):
            with _opened(folder) as part:
                for name in part.sums():
                    if part.holds(name):
                        with tell_errors(folder / name):
                            target.write(name, (folder / name).read_bytes())
                    else:
                        target.keep(name)
        target.finish(remove_others=overwrite)
        for folder in folders:
            _remove(folder)
    with suppress(OSError):
        parts.rmdir()
    return len(folders)


def _checked(folders: Sequence[Path], target: OutputFolder, track: Track) -> dict[str, str]:
    """The lists of all parts as one, after a look at every file."""
    sums: dict[str, str] = {}
    for folder in map(folders.__getitem__, track(range(len(folders)))):
        with _opened(folder) as part:
            for name, digest in part.sums().items():
                if sums.setdefault(name, digest) != digest:
                    raise InputError(f"{folder / name}: another part has another file of this name")
                if not part.holds(name) and not (target.sums().get(name) == digest and target.holds(name)):
                    raise InputError(f"{folder / name}: not as its list says; make this part again with --resume")
    return sums


def _remove(folder: Path) -> None:
    """Remove what a run wrote into the folder; what else is there stays."""
    with _opened(folder) as part:
        part.finish(remove_others=True)
    with suppress(OSError):
        (folder / SUMS).unlink()
        for place in sorted({*part.folders(), folder}, reverse=True):
            if place.is_dir():
                place.rmdir()


@contextmanager
def _opened(folder: Path) -> Generator[OutputFolder, None, None]:
    part = folder_of(folder)
    with part.open(refusal=None):
        yield part
