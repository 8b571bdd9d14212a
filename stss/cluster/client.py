# SPDX-License-Identifier: MIT
"""Connect to the workers of an address, and send them work.

Dask's own protocol carries pickled Python objects, so whoever can reach a scheduler can run code on it (docs/farm.md).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from threading import Thread
from typing import Any

from stss_ground.errors import InputError
from stss_ground.optional import require

LOCAL = "local:"
MAX_LOCAL = 256
WAIT = 60
"""Seconds for a scheduler to answer and for its first worker to come."""
QUIET: dict[str, Any] = {
    # Dask's 64 KiB gives a frame's memory back to the system after each use: a fifth more time, all of it the system's.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
    # Dask looks at the worker's Python stack a hundred times a second and wakes its loops fifty times: 3 % more processor time.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
}
"""Dask's settings for workers that are started here."""
ANY_PORT = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
"""Dask's scheduler serves HTTP even without a dashboard, and warns if another one has its usual port."""
FAREWELL = 5
"""Seconds for workers to drop the work."""


def ask(name: str, method: str, *arguments: Any) -> Any:
    """Runs on a worker: call a method of what `crew` put there."""
    return getattr(distributed().get_worker().plugins[name].work, method)(*arguments)


class Crew:
    """The workers of a client that have the same work."""

    def __init__(self, client: Any, name: str):
        self.client, self._name = client, name
        self._seen = time.monotonic()

    def addresses(self) -> list[str]:
        """The workers that there are now."""
        return list(self.client.scheduler_info(n_workers=-1)["workers"])

    def introductions(self) -> dict[str, Any]:
        """What ``introduce`` of each worker's work returns, by its address."""
        asked = {address: self.submit("introduce", workers=[address]) for address in self.addresses()}
        return {address: future.result() for address, future in asked.items()}

    def require_some(self) -> None:
        """Raise InputError if there has been no worker for `WAIT` seconds: one that dies while it starts does not come back."""
        if self.addresses():
            self._seen = time.monotonic()
        elif time.monotonic() - self._seen > WAIT:
            raise InputError(f"--cluster: every worker has ended, and none has come for {WAIT} s")

    def submit(self, method: str, *arguments: Any, workers: Sequence[str] | None = None, others: bool = False) -> Any:
        """Call a method of the work on any worker, or on one of ``workers``; returns dask's future.

        Args:
            method, arguments: what to call.
            workers: addresses; None: any.
            others: where all of ``workers`` have ended, any worker will do.
        """
        return self.client.submit(
            ask, self._name, method, *arguments, pure=False, workers=workers, allow_other_workers=others
        )  # fmt: skip


@contextmanager
def crew(client: Any, make: Callable[[], Any]) -> Generator[Crew, None, None]:
    """Send work to each worker once, including those that come later; they drop it at the end.

    Args:
        client: see `connected`.
        make: makes the work, on the worker.
    """

    def setup(self: Any, worker: Any) -> None:
        del worker
        self.work = make()

    name = f"stss-{os.getpid()}-{time.time_ns()}"
    plugin = type("Plugin", (distributed().WorkerPlugin,), {"name": name, "setup": setup})
    client.register_plugin(plugin(), name=name)
    try:
        yield Crew(client, name)
    finally:
        _forget(client, name)


def _forget(client: Any, name: str) -> None:
    """A worker that hangs never answers and is not waited for."""

    def tell() -> None:
        with suppress(Exception):  # a scheduler that is gone takes it along
            client.unregister_worker_plugin(name)

    telling = Thread(target=tell, daemon=True)
    telling.start()
    telling.join(FAREWELL)


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
            require("dask", "cluster").config.set(QUIET),
            dask.LocalCluster(
                n_workers=int(count), threads_per_worker=1, scheduler_kwargs=ANY_PORT, worker_dashboard_address=None,
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
    except (OSError, dask.TimeoutError, ValueError) as error:
        raise InputError(f"--cluster {address}: no scheduler answers: {str(error).splitlines()[0]}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=WAIT)
        except dask.TimeoutError as error:
            raise InputError(f"--cluster {address}: no worker within {WAIT} s") from error
        yield client


def _share_of_threads(workers: int) -> dict[str, str]:
    """Environment for PoCL, which else uses every processor in each process and pins its threads to the same ones."""
    if workers == 1:
        return {}
    return {"POCL_MAX_PTHREAD_COUNT": str(max(1, (os.cpu_count() or 1) // workers)), "POCL_AFFINITY": "0"}
