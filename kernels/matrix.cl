// Whether matrix units compute what mma.clh says: one product of 16 x 16 by 16 x 8.
//
//  buffer  dir  shape                content
//  a       in   (32) of uint4        of each work-item, see mma.clh
//  b       in   (32) of uint2        likewise
//  d       out  (4, 32) of float4    likewise, of each of four times the same product: 1 + a b
//
// Build -D HALF, optionally -D EMULATE.  Launch (32, 4), one work-group.
#include "common.clh"
#include "mma.clh"

kernel __attribute__((reqd_work_group_size(32, 4, 1)))
void matrix(global const uint4 *restrict a, global const uint2 *restrict b, global float4 *restrict d)
{
    EXCHANGE(exchange);
    const int lane = get_local_id(0), warp = get_local_id(1);
    const uint4 x = a[lane];
    const uint2 y = b[lane];
    float4 sum = 1.0f;
    MULTIPLY_ADD(sum, x, y, exchange, warp, lane);
    d[32 * warp + lane] = sum;
}
