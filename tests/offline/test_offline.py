"""The output of the offline compilers is read rightly, and the kernels for GPUs stay within their budgets."""

from pathlib import Path

import pytest

from stss_cl.device.program import source
from tests.offline.__main__ import TARGETS, row_of
from tests.offline.budgets import BUDGETS, faults
from tests.offline.compilers import Compiled, CompileError, MissingError, compiled, intel_kernels, require

LAYER = ["-cl-std=CL1.2", "-cl-mad-enable", "-cl-denorms-are-zero", "-DA=24", "-DB=24", "-DOUT=24", "-DSTRIDE=1", "-DRELU"]
CASES = [
    ("conv_local", [*LAYER, "-DSLICES=3", "-DMARK=0"]),
    ("conv_local", [*LAYER, "-DSLICES=3", "-DMARK=1", "-DGATED"]),
    ("conv_mma", [*LAYER, "-DMARK=0", "-DSTORED=HALF", "-DGATED", "-DOUTPUTS=24", "-DEIGHTS_AT_ONCE=3"]),
]

LISTING = """
//.kernel conv_local
//.thread_config numGRF=256, numAcc=8, numSWSB=16
//.spill size 96
"""
DESCRIPTION = "\tTotalInlineLocalMemorySize = 9888\n\tPerThreadPrivateMemorySize= 384\n"


def test_what_intel_says(tmp_path):
    """What has a description is what runs."""
    (tmp_path / "a_1_simd8_entry_0001.asm").write_text(LISTING.replace("size 96", "size 0"))
    (tmp_path / "a_1_simd8_entry_0001.cos").write_text(DESCRIPTION)
    (tmp_path / "a_simd8_entry_0001.asm").write_text(LISTING)
    assert intel_kernels(tmp_path) == {"conv_local": Compiled(registers=256, stack=384, spilled=0, local=9888)}
    (tmp_path / "a_simd8_entry_0001.cos").write_text(DESCRIPTION)
    assert intel_kernels(tmp_path)["conv_local"].spilled == 96


def test_what_exceeds_a_budget_is_told():
    good = Compiled(registers=128, stack=0, spilled=0, local=18848)
    assert faults("conv_local", good, "sm_90") == []
    spilled = Compiled(registers=255, stack=64, spilled=64, local=18848)
    lines = faults("conv_local", spilled, "sm_90")
    assert [line.split()[1] for line in lines] == ["registers,", "bytes", "spilled,"]


def need(target):
    try:
        require(target)
    except MissingError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize(("kernel", "options"), CASES, ids=["plain", "gated", "matrix"])
def test_budgets(kernel, options, target, tmp_path: Path):
    need(target)
    row = row_of(target)
    if kernel == "conv_mma" and row != "nvidia":
        pytest.skip(f"{target} has no matrix units that we use")
    rows = 1 if row == "intel" else 2
    usage = compiled(source(f"{kernel}.cl"), [*options, f"-DROWS={rows}"], [kernel], target, tmp_path)[kernel]
    assert faults(kernel, usage, target) == []
    assert usage.local > 0
    assert kernel in BUDGETS


def test_what_does_not_compile_is_told(tmp_path):
    need("gfx1100")
    with pytest.raises(CompileError, match="error"):
        compiled("kernel void k(global float *a) { a[0] = b; }", ["-cl-std=CL1.2"], ["k"], "gfx1100", tmp_path)
