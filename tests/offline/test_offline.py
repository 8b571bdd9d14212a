"""What the offline compilers say is read rightly, and the kernels for GPUs stay within their budgets."""

from pathlib import Path

import pytest

from stss_cl.device.program import source
from tests.offline import hottest_loop, intel
from tests.offline.__main__ import TARGETS, row_of
from tests.offline.budgets import BUDGETS, faults
from tests.offline.compilers import Compiled, CompileError, MissingError, compiled, require
from tests.offline.hottest_loop import Loop

LAYER = ["-cl-std=CL1.2", "-cl-mad-enable", "-DA=24", "-DB=24", "-DOUT=24", "-DSTRIDE=1", "-DRELU"]
CASES = [
    ("conv_local", LAYER),
    ("conv_local", [*LAYER, "-DGATED", "-DMARK"]),
    ("conv_mma", [*LAYER, "-DHALF", "-DGATED", "-DOUTPUTS=24", "-DEIGHTS=3"]),
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


LISTING = """
//.kernel conv_local
//.thread_config numGRF=256, numAcc=8, numSWSB=16
//.spill size 96

L24:
_0_025:
(W)     sync.bar                             null
(W)     mad (1|M0)               r4.0<1>:d     r4.0<0;0>:d       r2.0<0;0>:d       6:w
        mad (8|M0)               r5.0<1>:f     r4.0<0;0>:f       r2.0<0;0>:f       r7.0:f
(W)     send.dc0 (8|M0)          null     r3      r4:1    0x0            0x020F0000           {$4}
(f1.1)  goto.b (8|M0)                        _0_025            _0_027                                // $1232
_0_027:
(f1.0)  goto.b (8|M0)                        _0_027            L24                                // $1232
"""
DESCRIPTION = "\tTotalInlineLocalMemorySize = 9888\n\tPerThreadPrivateMemorySize= 384\n"


def test_what_intel_says(tmp_path):
    """Integers' multiply-adds do not count; what has a description is what runs."""
    (tmp_path / "a_1_simd8_entry_0001.asm").write_text(LISTING.replace("size 96", "size 0"))
    (tmp_path / "a_1_simd8_entry_0001.cos").write_text(DESCRIPTION)
    (tmp_path / "a_simd8_entry_0001.asm").write_text(LISTING)
    found = intel.listings(tmp_path)
    assert intel.figures(*found["conv_local"])["spilled"] == 0
    figures = intel.figures(LISTING, DESCRIPTION)
    assert figures == {"registers": 256, "stack": 384, "spilled": 96, "local": 9888, "loop": Loop(6, 1, 1)}


def test_the_hottest_loop_of_nvidia():
    assert hottest_loop.hottest(hottest_loop.nvidia(SASS, "conv_local")) == Loop(instructions=4, multiply_adds=2, memory=0)


def test_the_hottest_loop_of_amd():
    assert hottest_loop.hottest(hottest_loop.amd(ASSEMBLY, "conv_local")) == Loop(instructions=3, multiply_adds=2, memory=0)


def test_what_exceeds_a_budget_is_told():
    good = Compiled(registers=128, stack=0, spilled=0, local=18848, loop=Loop(100, 93, 5))
    assert faults("conv_local", good, "sm_90") == []
    spilled = Compiled(registers=255, stack=64, spilled=64, local=18848, loop=Loop(100, 60, 35))
    told = faults("conv_local", spilled, "sm_90")
    assert [line.split()[1] for line in told] == ["registers,", "bytes", "spilled,", "multiply-adds"]


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize(("kernel", "options"), CASES, ids=["plain", "gated", "matrix"])
def test_budgets(kernel, options, target, tmp_path: Path):
    try:
        require(target)
    except MissingError as error:
        pytest.skip(str(error))
    row = row_of(target)
    if kernel == "conv_mma" and row != "nvidia":
        pytest.skip(f"{target} has no matrix units that we use")
    rows = 1 if row == "intel" else 2
    found = compiled(source(f"{kernel}.cl"), [*options, f"-DROWS={rows}"], [kernel], target, tmp_path)[kernel]
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
