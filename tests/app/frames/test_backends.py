"""Backends: threads that share one take turns."""

import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

from stss.frames.backends import OpenCLBackend
from stss.frames.compute_options import ComputeOptions
from stss_ref.weights import zeros


def test_threads_that_share_a_backend_take_turns(monkeypatch):
    inside, most = [], []

    class Stream:
        def __init__(self, *_, **__):
            pass

        def __call__(self, window, steps):
            inside.append(window)
            most.append(len(inside))
            time.sleep(0.01)
            inside.remove(window)
            return window

        def expect(self, size):
            self(size, None)

    device = SimpleNamespace(kind="CPU", device_class="cpu", name="n", driver="d")
    monkeypatch.setattr("stss.devices.selection.choose", lambda *_, **__: device)
    monkeypatch.setattr("stss_cl.skip.stream.Stream", Stream)
    monkeypatch.setattr("stss_cl.image_space.output.OutputKernels", lambda _: SimpleNamespace(load=lambda: None))
    backend = OpenCLBackend(zeros(), ComputeOptions(), print)
    with ThreadPoolExecutor(3) as threads:
        threads.submit(backend.expect, "size")
        assert list(threads.map(lambda n: backend.compute([n], (0, 0, 0)), range(9))) == [[n] for n in range(9)]
    assert max(most) == 1
