// SPDX-License-Identifier: MIT
// Building block widen, NumPy's astype(float32): planes of a display frame in half; every value is kept.
//
//  buffer  dir  shape
//  from    in   (count)   half
//  to      out  (count)   float
//
// Launch ceil(count / 4) work-items or more; a work-item widens four values, the last one the rest.
kernel void widen(global const half *restrict from, global float *restrict to, const ulong count)
{
    const ulong first = 4 * get_global_id(0);
    if (first + 4 <= count)
        vstore4(vload_half4(0, from + first), 0, to + first);
    else
        for (ulong i = first; i < count; ++i) to[i] = vload_half(i, from);
}
