# SPDX-License-Identifier: MIT
"""Connect to the workers of an address, and send them work.

Dask's own protocol carries pickled Python objects, so whoever can reach a scheduler can run code on it (docs/farm.md).
"""

from __future__ import annotations

import os
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from threading import Thread
from typing import Any

from stss.cluster.worker import Chunk, Introduction, Work, Worker
from stss.errors import InputError
from stss.optional import require

LOCAL = "local:"
MAX_LOCAL = 256
WAIT = 60
"""Seconds for a scheduler to answer and for its first worker to come."""
FAREWELL = 5
"""Seconds for workers to drop the work."""


def introduce(name: str) -> Introduction:
    """Runs on a worker: see `Worker.introduce`."""
    return _worker(name).introduce()


def compute_chunk(name: str, numbers: Sequence[int], backends: frozenset[str]) -> Chunk:
    """Runs on a worker: see `Worker.compute`."""
    return _worker(name).compute(numbers, backends)


def _worker(name: str) -> Worker:
    return distributed().get_worker().plugins[name].worker


def send(client: Any, name: str, work: Work) -> None:
    """Send the work to each worker once, including those that come later."""

    def setup(self: Any, worker: Any) -> None:
        del worker
        self.worker = Worker(work)

    plugin = type("Plugin", (distributed().WorkerPlugin,), {"name": name, "setup": setup})
    client.register_plugin(plugin(), name=name)


def forget(client: Any, name: str) -> None:
    """Tell the workers to drop the work; a worker that hangs never answers and is not waited for."""

    def ask() -> None:
        with suppress(Exception):  # a scheduler that is gone takes it along
            client.unregister_worker_plugin(name)

    asking = Thread(target=ask, daemon=True)
    asking.start()
    asking.join(FAREWELL)


def distributed() -> Any:
    """The package ``distributed``; raises InputError where the extra ``cluster`` is not installed."""
    return require("distributed", "cluster")


@contextmanager
def connected(address: str) -> Generator[Any, None, None]:
    """Connect to the scheduler at the address, or to processes started here, which end with the connection.

    Raises:
        InputError: the address has another form, or no scheduler or worker answers there.
    """
    dask = distributed()
    if address.startswith(LOCAL):
        count = address.removeprefix(LOCAL)
        if not (count.isascii() and count.isdecimal() and 1 <= int(count[:9]) <= MAX_LOCAL):
            raise InputError(f"--cluster: expected {LOCAL}N with N from 1 to {MAX_LOCAL}, got {address}")
        with (
            dask.LocalCluster(
                n_workers=int(count), threads_per_worker=1, dashboard_address=None, worker_dashboard_address=None,
                env=_share_of_threads(int(count)), silence_logs=50, memory_limit=0,
            ) as processes,
            dask.Client(processes) as client,
        ):  # fmt: skip
            client.wait_for_workers(int(count), timeout=WAIT)
            yield client
        return
    if "://" not in address:
        raise InputError(f"--cluster: expected {LOCAL}N or a scheduler such as tcp://host:8786, got {address}")
    try:
        client = dask.Client(address, timeout=WAIT)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(f"--cluster {address}: no scheduler answers: {str(error).splitlines()[0]}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=WAIT)
        except TimeoutError as error:
            raise InputError(f"--cluster {address}: no worker within {WAIT} s") from error
        yield client


def _share_of_threads(workers: int) -> dict[str, str]:
    """Environment for PoCL, which else uses every processor in each process and pins its threads to the same ones."""
    if workers == 1:
        return {}
    return {"POCL_MAX_PTHREAD_COUNT": str(max(1, (os.cpu_count() or 1) // workers)), "POCL_AFFINITY": "0"}
