"""Processors that PoCL's compiler does not know: they get the name of one that it knows, and never of one that can do more."""

import ctypes
from types import SimpleNamespace

import pytest

from stss_cl.device import pocl_processor
from stss_cl.device.discovery import Properties
from stss_cl.device.pocl_processor import AVX2, AVX512, ICE_LAKE, given_name, name_processor, substitute
from tests.cl.conftest import opened_as

VERSION = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-"


@pytest.fixture
def machine(monkeypatch):
    """A processor that can do ``flags``, in whose record the name stands at ``place``; gives its handle and what the record then names."""
    calls_kept = []

    def make(flags, name="generic", place=640):
        monkeypatch.setattr(pocl_processor, "cpu_flags", lambda: frozenset(flags))
        monkeypatch.setattr(pocl_processor.sys, "platform", "linux")
        monkeypatch.setattr(pocl_processor, "given_names", {})
        substitute.cache_clear()
        own, other, record = (
            ctypes.create_string_buffer(name.encode()),
            ctypes.create_string_buffer(b"generic-ish"),
            (ctypes.c_void_p * 1024)(),
        )
        record[place // 8], record[3] = ctypes.addressof(own), ctypes.addressof(other)
        record[5] = 8  # a number that is no address
        calls_kept.append((own, other, record))
        handle = SimpleNamespace(version=VERSION + name, int_ptr=ctypes.addressof(record), type=2)
        return handle, lambda: ctypes.string_at(record[place // 8]).decode()

    yield make
    substitute.cache_clear()


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (ICE_LAKE, "icelake-client"),
        (ICE_LAKE - {"avx512_vbmi2"}, "skylake-avx512"),
        (AVX512 - {"avx512vl"}, "haswell"),
        (AVX2 - {"fma"}, "x86-64"),
    ],
)
def test_an_unknown_processor_gets_the_name_of_one_that_can_do_no_more(machine, flags, name):
    handle, named = machine(flags)
    assert (named(), given_name(handle)) == ("generic", "")
    name_processor(handle)
    assert named() == given_name(handle) == Properties(handle).target == name
    name_processor(handle)
    assert named() == name


def test_what_is_known_or_not_to_be_found_stays(machine):
    handle, named = machine(ICE_LAKE, "znver3")
    name_processor(handle)
    assert (named(), Properties(handle).target) == ("znver3", "znver3")
    handle, named = machine(ICE_LAKE, place=pocl_processor.RECORD)
    name_processor(handle)
    assert (named(), Properties(handle).target) == ("generic", "generic")
    handle, named = machine(())  # a system that doesn't say
    name_processor(handle)
    assert named() == "generic"


@pytest.mark.parametrize(("version", "target"), [("cpu-x86_64-pc-linux-gnu-skylake-avx512", "skylake-avx512"), ("(Build 0)", "")])
def test_what_is_compiled_for_stands_in_the_version(version, target):
    assert Properties(SimpleNamespace(version=f"OpenCL 3.0 PoCL HSTR: {version}", type=2)).target == target


@pytest.mark.parametrize(("kind", "takes"), [(2, True), (4, False), (8, False)])
def test_processors_alone_get_prefetches(kind, takes):
    assert Properties(SimpleNamespace(platform=SimpleNamespace(name="any"), name="any", type=kind)).takes_prefetch is takes


def test_memory_that_is_not_there_is_no_fault():
    assert pocl_processor.read_memory(8, 8) == b""


def test_this_processor_is_one_for_which_kernels_build():
    assert opened_as("cpu").target != "generic"
