// SPDX-License-Identifier: MIT
// Stage encoder, the input: reference stss_ref/encoder.py (the concatenation) and stss_ref/resample.py::pad_to_8.
//
//  buffer   dir  shape              content
//  color    in   (H, W, 6)          occlusion_warp and warped of the newest frame
//  gbuffer  in   (H, W, 9)          normal 3, depth, roughness, metallic, base colour 3
//  mask     in   (H, W)             1 = can be trusted
//  history  in   (3, H, W, 4)       oldest, middle, newest
//  input    out  padded, (24)       color 6, color * mask 6, gbuffer 9, zeros 3
//  base     out  (H8, W8, 4)        color 0..2 and 0: the image that the decoder adds
//  padded   out  3 padded, (4)      the history
//  bad      out  (2)                set to 1 where an input is not finite: color, gbuffer, mask; history
//
// Beyond H, W up to multiples of 8 the last row and column are repeated.
// The outputs may be a strip of the frame: their row 0 is the frame's row `top`.
// Build optionally -D STORED -D ROW_AT_ONCE.  Launch (W8, H8), in groups of at most 64 along a row, and for the history
// (W8, H8, 3) or, with ROW_AT_ONCE, (1, H8, 3); H8 is the strip's, a multiple of 8.
#include "common.clh"
#include "change_map.clh"

#ifdef ROW_AT_ONCE
#define COLORS global
#else
#define COLORS local
#endif

// The channels of a pixel in three eights; returns a number other than 0 if one is not finite.
static inline int4 pack_pixel(COLORS const float *c, COLORS const float *g, const float m, float8 *eights)
{
    // Element by element: PoCL's vload4 is a call.
    eights[0] = (float8)(c[0], c[1], c[2], c[3], c[4], c[5], c[0] * m, c[1] * m);
    eights[1] = (float8)(c[2] * m, c[3] * m, c[4] * m, c[5] * m, g[0], g[1], g[2], g[3]);
    eights[2] = (float8)(g[4], g[5], g[6], g[7], g[8], 0.0f, 0.0f, 0.0f);
    const int8 wrong =
        not_finite8(eights[0]) | not_finite8(eights[1]) | not_finite8(eights[2]) | not_finite8((float8)(m));
    return wrong.lo | wrong.hi;
}

#ifdef ROW_AT_ONCE
kernel void pack_input(global const float *restrict color, global const float *restrict gbuffer,
                       global const float *restrict mask, global stored *restrict input, global float4 *restrict base,
                       global int *restrict bad, const int height, const int width, const int columns, const int top)
{
    const int x = get_global_id(0), y = get_global_id(1);
    const int from = least(top + y, height - 1) * width + least(x, width - 1), to = ((y + 1) * columns + x + 1) * 3;
    global const float *c = color + 6 * from;
    float8 eights[3];
    const int4 wrong = pack_pixel(c, gbuffer + 9 * from, mask[from], eights);
#pragma unroll
    for (int i = 0; i < 3; ++i) STREAM8(eights[i], to + i, input);
    base[y * (columns - 2) + x] = (float4)(c[0], c[1], c[2], 0.0f);
    if ((wrong.x | wrong.y | wrong.z | wrong.w) != 0) bad[0] = 1;
}
#else
#define MOST_ITEMS 64

kernel void pack_input(global const float *restrict color, global const float *restrict gbuffer,
                       global const float *restrict mask, global stored *restrict input, global float4 *restrict base,
                       global int *restrict bad, const int height, const int width, const int columns, const int top)
{
    // Neighbours load and store numbers in a row, through local memory.
    local float colors[6 * MOST_ITEMS], materials[9 * MOST_ITEMS];
    local stored8 packed[3 * MOST_ITEMS];
    const int item = get_local_id(0), items = get_local_size(0), x = get_global_id(0), y = get_global_id(1);
    const int row = least(top + y, height - 1) * width, first = x - item;
    for (int i = item; i < 6 * items; i += items)
        colors[i] = color[6 * (row + least(first + i / 6, width - 1)) + i % 6];
    for (int i = item; i < 9 * items; i += items)
        materials[i] = gbuffer[9 * (row + least(first + i / 9, width - 1)) + i % 9];
    barrier(CLK_LOCAL_MEM_FENCE);
    local const float *c = colors + 6 * item;
    float8 eights[3];
    const int4 wrong = pack_pixel(c, materials + 9 * item, mask[row + least(x, width - 1)], eights);
#pragma unroll
    for (int i = 0; i < 3; ++i) packed[3 * item + i] = NARROW8(eights[i]);
    base[y * (columns - 2) + x] = (float4)(c[0], c[1], c[2], 0.0f);
    if ((wrong.x | wrong.y | wrong.z | wrong.w) != 0) bad[0] = 1;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int i = item; i < 3 * items; i += items)
        ((global stored8 *)input)[((y + 1) * columns + first + 1) * 3 + i] = packed[i];
}
#endif

#ifdef ROW_AT_ONCE
typedef float16 four_pixels __attribute__((aligned(16)));
#if STORED == FLOAT
typedef float16 four_stored __attribute__((aligned(16)));
#define STORED16(value) value
#else
typedef ushort16 four_stored __attribute__((aligned(8)));
#define STORED16(value) narrow16(value)
#endif

kernel __attribute__((reqd_work_group_size(1, 1, 1))) void pack_history(
    global const float4 *restrict history, global stored *restrict padded, global int *restrict bad, const int height,
    const int width, const int rows, const int columns, const int top)
{
    const int y = get_global_id(1), i = get_global_id(2);
    global const float4 *from = history + (i * height + least(top + y, height - 1)) * width;
    global stored *to = padded + ((i * rows + y + 1) * columns + 1) * 4;
    int16 wrong = 0;
    for (int x = 0; x < columns - 2; x += 4) {
        float16 v;
        if (x + 4 <= width)
            v = *(global const four_pixels *)(from + x);
        else
            v = (float16)(from[least(x, width - 1)], from[least(x + 1, width - 1)], from[least(x + 2, width - 1)],
                          from[width - 1]);
        wrong |= (as_uint16(v) & 0x7fffffffu) >= 0x7f800000u;
        *(global four_stored *)(to + 4 * x) = STORED16(v);
    }
    const int8 eight = wrong.lo | wrong.hi;
    const int4 four = eight.lo | eight.hi;
    if ((four.x | four.y | four.z | four.w) != 0) bad[1] = 1;
}
#else
kernel void pack_history(global const float4 *restrict history, global stored *restrict padded,
                         global int *restrict bad, const int height, const int width, const int rows, const int columns,
                         const int top)
{
    const int x = get_global_id(0), y = get_global_id(1), i = get_global_id(2);
    const float4 v = history[(i * height + least(top + y, height - 1)) * width + least(x, width - 1)];
    const int8 eight = not_finite8((float8)(v, v));
    if ((eight.s0 | eight.s1 | eight.s2 | eight.s3) != 0) bad[1] = 1;
    const int to = (i * rows + y + 1) * columns + x + 1;
    STREAM4(v, to, padded);
}
#endif
