"""Backends: threads that share one take turns, a slow start is told, and the reference follows its weights."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import stss
from stss.frames.backends import OpenCLBackend, ReferenceBackend
from stss.frames.compute_options import ComputeOptions
from stss_ground.errors import DeviceError
from stss_ref.frame import frame
from stss_ref.weights import zeros
from tests.cl.films import frame_inputs, uneven


def test_a_first_start_is_told(monkeypatch, caplog):
    """A program that names no ``tell`` finds it on standard error, where Python's logging writes warnings."""

    def choose(_, tell, **__):
        tell("first start: \x1b[1m")
        raise DeviceError("none")

    monkeypatch.setattr("stss.devices.selection.choose", choose)
    with pytest.raises(DeviceError, match="none"):
        stss.Supersampler("realtime")
    assert [(record.name, record.levelname, record.getMessage()) for record in caplog.records] == [
        ("stss", "WARNING", r"first start: \x1b[1m")
    ]


def test_threads_that_share_a_backend_take_turns(monkeypatch):
    inside, most = [], []

    class Stream:
        def __init__(self, *_, **__):
            pass

        def __call__(self, window, steps, *, stay=False):
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
    monkeypatch.setattr("stss_cl.image_space.accumulate.Accumulate", lambda _: None)
    monkeypatch.setattr("stss_cl.image_space.output.OutputKernels", lambda _: SimpleNamespace(load=lambda: None))
    backend = OpenCLBackend(zeros(), ComputeOptions(), print)
    with ThreadPoolExecutor(3) as threads:
        threads.submit(backend.expect, "size")
        assert list(threads.map(lambda n: backend.compute([n], (0, 0, 0)), range(9))) == [[n] for n in range(9)]
    assert max(most) == 1


@pytest.mark.parametrize("choice", [{"hole_test": "paper"}, {"hole_fill": "reshade"}], ids=str)
def test_weights_that_add_nothing_choose_holes_and_their_fill_all_the_same(choice):
    """The reference leaves their network out, and nothing else."""
    inputs, weights = frame_inputs((16, 24), **uneven((16, 24))), replace(zeros(), **choice)
    for got, want in zip(ReferenceBackend(weights).frame(inputs), frame(inputs, weights), strict=True):
        np.testing.assert_array_equal(got, want)
