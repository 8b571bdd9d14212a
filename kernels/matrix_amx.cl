// SPDX-License-Identifier: MIT
// One product of amx.clh: stss_cl/device/amx.py tests a processor's matrix units with it.
//
//  buffer  dir  shape        content
//  a       in   (16, 32)     bfloat16
//  b       in   (16, 16, 2)  bfloat16: pairs of inputs, outputs
//  bias    in   (16)
//  sums    out  (16, 16)     bias + a b
//
// Build optionally -D EMULATE.  Launch (1).
#include "common.clh"
#include "amx.clh"

kernel __attribute__((reqd_work_group_size(1, 1, 1))) void matrix_amx(global const ushort *restrict a,
                                                                      global const ushort *restrict b,
                                                                      global const float *restrict bias,
                                                                      global float *restrict sums)
{
    TILES_BEGIN(32);
    float made[16 * 16] __attribute__((aligned(64)));
    TILE_LOAD(0, bias, 0);
    TILE_LOAD(4, a, 64);
    TILE_LOAD(6, b, 64);
    TILE_MULTIPLY(0, 4, 6);
    TILE_STORE(0, made);
    for (int i = 0; i < 16 * 16; ++i) sums[i] = made[i];
    TILES_END;
}
