// SPDX-License-Identifier: MIT
// Tests whether matrix units compute as mma.clh says: one product, four times.
//
//  buffer  dir  shape                         content
//  pixels  in   (2, UNIT) of uint4            of each pixel the first eight channels, then the others
//  weight  in   (MATRIX) of uint              see mma.clh
//  d       out  (WAVES, UNIT, PARTS * HELD)   1 + pixels x weights
//
// Build -D STORED=HALF, optionally -D EMULATE (mma.clh).  Launch (LANES, WAVES), one work-group.
#include "common.clh"
#include "mma.clh"

kernel __attribute__((reqd_work_group_size(LANES, WAVES, 1))) void matrix(global const uint4 *restrict pixels,
                                                                          global const uint *restrict weight,
                                                                          global float2 *restrict d)
{
    local uint4 tile[2 * UNIT];
    local uint matrix[MATRIX] __attribute__((aligned(16)));
    EXCHANGE(exchange);
    const int lane = get_local_id(0), wave = get_local_id(1);
    for (int i = lane; i < 2 * UNIT; i += LANES) tile[i] = pixels[i];
    for (int i = lane; i < MATRIX; i += LANES) matrix[i] = weight[i];
    barrier(CLK_LOCAL_MEM_FENCE);
    const uint4 v = read_inputs(tile, tile + UNIT, lane);
    const uint2 w = read_weights(matrix, lane);
    float4 sum = 1.0f;
    MULTIPLY_ADD(sum, v, w, exchange, wave, lane);
    for (int k = 0; k < ITS; ++k) d[(wave * UNIT + PIXEL(lane, k)) * PARTS + PART(lane)] = OF_PIXEL(sum, k);
}
