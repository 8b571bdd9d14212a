# SPDX-License-Identifier: MIT
"""The workers of an address: processes started here, or those of a dask.distributed scheduler."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Generator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from threading import Thread
from typing import Any

from stss_ground import machine
from stss_ground.errors import InputError
from stss_ground.optional import require

LOCAL = "local:"
MAX_LOCAL = 256
SAFE_PATH = "PYTHONSAFEPATH"
TIMEOUT = 60.0
"""Seconds for a scheduler to answer, and for a worker to come."""


class LocalWorkers:
    """Processes started here. They talk through pipes, so no other user of the machine can reach them."""

    def __init__(self, count: int):
        self._count = count

    def deaths(self) -> tuple[type[BaseException], ...]:
        """The error of a call whose worker died."""
        return (BrokenExecutor,)

    def count(self) -> int:
        """Their number now; 1 at least."""
        return self._count

    def start(self) -> Executor:
        """An executor of all workers that do not hang."""
        context = multiprocessing.get_context("spawn")  # a fork would copy the drivers' locks, but not the threads that hold them
        try:
            with _beginning():
                return _Pool(self._count, context, _begin, (self._count,))
        except OSError as error:  # some containers have no shared memory, in which the pool has its locks
            raise InputError(
                f"--cluster {LOCAL}{self._count}: processes share no lock here: /dev/shm: {error.strerror}; run without --cluster"
            ) from error

    def end(self, executor: Executor, *, hangs: bool) -> None:
        """Drop all tasks of the executor; its processes end, and the next executor starts others."""
        del hangs
        for process in multiprocessing.active_children():
            process.kill()
        executor.shutdown(cancel_futures=True)


class _Pool(ProcessPoolExecutor):
    """Processes that are started within `_beginning`."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # pyrefly: ignore[bad-override]
        with _beginning():
            return super().submit(fn, *args, **kwargs)


@contextmanager
def _beginning() -> Generator[None, None, None]:
    """Within the block, processes start with Ctrl-C blocked, and take no modules from the current folder.

    Ctrl-C reaches every process of a terminal, but the writing process ends the others. In the current folder the user may have a module
    with the name of one of Python's; Python 3.10 cannot leave the folder out.
    """
    blocks, own = hasattr(signal, "pthread_sigmask"), os.environ.get(SAFE_PATH)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if blocks else None
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if own is None:
            del os.environ[SAFE_PATH]
        if before is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(count: int) -> None:
    """Runs first in a process that was started here."""
    os.environ.pop(SAFE_PATH, None)
    Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True).start()
    machine.processes = count
    if count > 1:  # PoCL would use every processor in each process, and pin their threads to the same ones
        os.environ.update(POCL_MAX_PTHREAD_COUNT=str(machine.available_threads()), POCL_AFFINITY="0")


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)


class DaskWorkers:
    """The workers of a scheduler. They may come and go; the scheduler gives a dead one's tasks to another."""

    def __init__(self, client: Any):
        self._client, self._hung = client, set[str]()

    def deaths(self) -> tuple[type[BaseException], ...]:
        """See `LocalWorkers`."""
        return (CancelledError, require("distributed", "cluster").KilledWorker)

    def count(self) -> int:
        """See `LocalWorkers`."""
        return max(1, len(self._names()))

    def start(self) -> Executor:
        """See `LocalWorkers`."""
        names = self._names()
        if not names:
            raise InputError("--cluster: no worker is left; --resume goes on")
        return self._client.get_executor(pure=False, **({"workers": names} if self._hung else {}))

    def end(self, executor: Executor, *, hangs: bool) -> None:
        """Likewise; ``hangs``: workers with something to do never answer. One that does not hang computes its chunk to the end."""
        if hangs:
            self._hung |= {name for name, keys in self._client.processing().items() if keys}
        executor.shutdown(wait=False)

    def _names(self) -> list[str]:
        try:
            return [name for name in self._client.scheduler_info(n_workers=-1)["workers"] if name not in self._hung]
        except (OSError, ValueError) as error:
            raise InputError(f"--cluster: the scheduler is gone: {error}; --resume goes on") from error


Workers = LocalWorkers | DaskWorkers
"""The workers of an address, as one executor at a time."""


@contextmanager
def connect(address: str) -> Generator[Workers, None, None]:
    """Start processes, or connect to a scheduler.

    Args:
        address: ``local:N`` for N processes here, or a scheduler's, such as ``tcp://host:8786``.

    Raises:
        InputError: the address has another form, or no scheduler or worker answers there.
    """
    if address.startswith(LOCAL):
        count = address.removeprefix(LOCAL)
        if not (count.isascii() and count.isdecimal() and 1 <= int(count[:9]) <= MAX_LOCAL):
            raise InputError(f"--cluster: expected {LOCAL}N with N from 1 to {MAX_LOCAL}, got {address}")
        yield LocalWorkers(int(count))
        return
    if "://" not in address:
        raise InputError(f"--cluster: expected {LOCAL}N or a scheduler such as tcp://host:8786, got {address}")
    dask = require("distributed", "cluster")
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # a lost worker is one line of our own
    try:
        client = dask.Client(address, timeout=TIMEOUT)
    except (OSError, dask.TimeoutError, ValueError) as error:
        raise InputError(f"--cluster {address}: no scheduler answers: {str(error).splitlines()[0]}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=TIMEOUT)
        except dask.TimeoutError as error:
            raise InputError(f"--cluster {address}: no worker within {TIMEOUT:g} s") from error
        yield DaskWorkers(client)
