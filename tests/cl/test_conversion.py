"""Activations in half: the bits of IEEE 754, by arithmetic or by the processor's instructions, and the processors that are trusted with
these."""

import numpy as np
import pytest

from stss_cl.device import conversion
from stss_cl.device.buffers import BFLOAT16
from stss_ground.errors import DeviceError
from tests.cl.conftest import anew

HALF = np.dtype(np.float16)


def test_every_half_and_what_lies_between_two_are_rounded_to_even(device):
    assert conversion.conversions_are_right(device, None)


def test_the_processors_instructions_give_the_same_bits(processor):
    if not conversion.instructions(processor):
        pytest.skip("the processor, or its compiler, has no instructions that convert half (x86-64's F16C)")
    assert conversion.conversions_are_right(processor, "X86")
    assert conversion.storage_options(processor, HALF) == {"STORED": "HALF", "CONVERTS": "X86"}


def test_the_kernels_of_gpus_on_a_processor_take_none(gpu):
    if gpu.is_gpu:
        pytest.skip("the device is a GPU")
    assert conversion.storage_options(gpu, HALF) == {"STORED": "HALF", "CONVERTS": None}


@pytest.mark.parametrize("dtype", [np.dtype(np.float32), BFLOAT16])
def test_other_activations_do_not_ask(processor, monkeypatch, dtype):
    monkeypatch.setattr(conversion, "converts_half", None)
    monkeypatch.setattr(conversion.amx, "are_used", lambda _: False)
    assert conversion.storage_options(processor, dtype)["CONVERTS"] is None


@pytest.mark.parametrize("flags", [frozenset(), frozenset({"avx2"})])
def test_a_processor_without_them_is_not_tried(processor, monkeypatch, flags):
    monkeypatch.setattr(conversion, "cpu_flags", lambda: flags)
    monkeypatch.setattr(conversion, "conversions_are_right", None)
    assert not conversion.converts_half(anew(processor))


@pytest.mark.parametrize("wrong", ["one bit", "does not build"])
def test_wrong_instructions_are_not_used(processor, monkeypatch, wrong):
    """Tried once for each context."""
    tries = []

    def try_them(device, kind):
        tries.append(kind)
        if wrong == "does not build":
            raise DeviceError("invalid instruction mnemonic")
        return False

    monkeypatch.setattr(conversion, "cpu_flags", lambda: frozenset({"f16c"}))
    monkeypatch.setattr(conversion.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(conversion, "conversions_are_right", try_them)
    opened = anew(processor)
    assert not conversion.converts_half(opened)
    assert conversion.storage_options(opened, HALF)["CONVERTS"] is None
    assert tries == (["X86"] if processor.is_pocl_processor else [])
