"""What the offline compilers say is read rightly, and the kernels for GPUs stay within their budgets."""

from pathlib import Path

import pytest

from stss_cl.device.program import source
from tests.offline import hottest_loop
from tests.offline.budgets import BUDGETS, faults
from tests.offline.compilers import Compiled, CompileError, MissingError, compiled, require
from tests.offline.hottest_loop import Instruction, Loop

LAYER = ["-cl-std=CL1.2", "-cl-mad-enable", "-DA=24", "-DB=24", "-DOUT=24", "-DSTRIDE=1", "-DROWS=2", "-DRELU"]
CASES = [
    ("conv_local", LAYER),
    ("conv_local", [*LAYER, "-DGATED", "-DMARK"]),
    ("conv_mma", [*LAYER, "-DHALF", "-DGATED", "-DBLOCK=24", "-DEIGHTS=3"]),
]

SASS = """
.text.conv_local:
        /*0000*/                   LDC R1, c[0x0][0x28] ;
.L_x_1:
        /*0010*/                   LDS.128 R4, [R2] ;
.L_x_0:
        /*0020*/                   FFMA R8, R4, R5, R8 ;
        /*0030*/                   FFMA R9, R4, R6, R9 ;
        /*0040*/                   IADD3 R3, R3, 0x1, RZ ;
        /*0050*/              @!P0 BRA `(.L_x_0) ;
        /*0060*/               @P1 BRA `(.L_x_1) ;
        /*0070*/                   EXIT ;
//--------------------- .text.other
"""
ASSEMBLY = """
conv_local:
\ts_load_b32 s0, s[4:5], 0x0
.LBB0_1:
\tv_fmac_f32_e32 v1, v2, v3
\tv_dual_fmac_f32 v4, v2, v5 :: v_dual_fmac_f32 v6, v2, v7
\ts_cbranch_scc1 .LBB0_1
\ts_endpgm
.Lfunc_end0:
"""


def test_the_hottest_loop_of_nvidia():
    assert hottest_loop.hottest(hottest_loop.nvidia(SASS, "conv_local")) == Loop(instructions=4, multiply_adds=2, memory=0)


def test_the_hottest_loop_of_amd():
    assert hottest_loop.hottest(hottest_loop.amd(ASSEMBLY, "conv_local")) == Loop(instructions=3, multiply_adds=2, memory=0)


def test_code_without_a_loop_counts_whole():
    code = [Instruction("FFMA"), Instruction("LDG"), Instruction("STG")]
    assert hottest_loop.hottest(code) == Loop(instructions=3, multiply_adds=1, memory=2)


def test_what_exceeds_a_budget_is_told():
    good = Compiled(registers=128, stack=0, spilled=0, local=18848, loop=Loop(100, 93, 5))
    assert faults("conv_local", good, "sm_90") == []
    spilled = Compiled(registers=255, stack=64, spilled=64, local=18848, loop=Loop(100, 60, 35))
    told = faults("conv_local", spilled, "sm_90")
    assert [line.split()[1] for line in told] == ["registers,", "bytes", "spilled,", "multiply-adds"]


@pytest.mark.parametrize("target", ["sm_80", "sm_90", "gfx1100", "gfx90a"])
@pytest.mark.parametrize(("kernel", "options"), CASES, ids=["plain", "gated", "matrix"])
def test_budgets(kernel, options, target, tmp_path: Path):
    if kernel == "conv_mma" and not target.startswith("sm_"):
        pytest.skip("conv_mma.cl is NVIDIA's")
    try:
        require(target)
    except MissingError as error:
        pytest.skip(str(error))
    found = compiled(source(f"{kernel}.cl"), options, [kernel], target, tmp_path)[kernel]
    assert faults(kernel, found, target) == []
    assert found.local > 0
    assert found.loop.multiply_adds > 0
    assert kernel in BUDGETS


def test_what_does_not_compile_is_told(tmp_path):
    try:
        require("gfx1100")
    except MissingError as error:
        pytest.skip(str(error))
    with pytest.raises(CompileError, match="error"):
        compiled("kernel void k(global float *a) { a[0] = b; }", ["-cl-std=CL1.2"], ["k"], "gfx1100", tmp_path)
