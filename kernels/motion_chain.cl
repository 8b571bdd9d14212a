// SPDX-License-Identifier: MIT
// Stage motion_chain, reference stss_ref/motion_chain.py::motion_chain.
//
//  buffer   dir  shape            unit
//  motions  in   (k, H, W, 2)     px, frames t, t-1, ..., newest first, each to the frame before it; may be non-finite
//  motion   out  (H, W, 2)        px, frame t to frame t-k
//
// Build -D GATHER=gather_longest | gather_nearest | gather_bilinear.  Launch (W, H) rounded up.
#ifndef GATHER
#error "motion_chain.cl needs -D GATHER=name of a function"
#endif
#include "sample.clh"

// motion at a whole pixel, 0 outside the frame
static inline float2 read_motion(global const float2 *motion, const int x, const int y, const int height, const int width)
{
    return x >= 0 && x < width && y >= 0 && y < height ? motion[y * width + x] : (float2)(0.0f);
}

// trunc of a place, towards zero: places between -1 and 0 give 0. Farther left it is floor, which reads 0 as well.
INLINE int truncated(const int whole, const float fraction)
{
    return whole + ((whole == -1) & (fraction > 0.0f));
}

INLINE float2 gather_longest(global const float2 *motion, const Place at, const int height, const int width)
{
    // A pixel outside the frame is 0, and a 0 among the four wins.
    const int x = truncated(at.x, at.fx), y = truncated(at.y, at.fy);
    if ((uint)x >= (uint)(width - 1) || (uint)y >= (uint)(height - 1)) return (float2)(0.0f);
    global const float2 *restrict corner = motion + y * width + x;
    const float4 top = read4(corner), bottom = read4(corner + width);
    const float4 u = (float4)(top.xz, bottom.xz), v = (float4)(top.yw, bottom.yw);
    const int4 still = u == 0.0f && v == 0.0f;
    if (still.x | still.y | still.z | still.w) return (float2)(0.0f);
    const float4 squared = u * u + v * v, length = squared < INFINITY ? squared : (float4)(INFINITY);  // NaN is the longest, too
    // Only a strictly longer motion replaces the longest, so that the first in raster order stays.
    const int4 eastern = length.yyww > length.xxzz;
    const float4 longest = eastern ? (float4)(top.zw, bottom.zw) : (float4)(top.xy, bottom.xy);
    const float4 of = eastern ? length.yyww : length.xxzz;
    return of.zw > of.xy ? longest.zw : longest.xy;
}

INLINE float2 gather_nearest(global const float2 *motion, const Place at, const int height, const int width)
{
    return read_motion(motion, at.x + (at.fx >= 0.5f), at.y + (at.fy >= 0.5f), height, width);
}

INLINE float2 gather_bilinear(global const float2 *motion, const Place at, const int height, const int width)
{
    const float2 nw = read_motion(motion, at.x, at.y, height, width), ne = read_motion(motion, at.x + 1, at.y, height, width);
    const float2 sw = read_motion(motion, at.x, at.y + 1, height, width), se = read_motion(motion, at.x + 1, at.y + 1, height, width);
    return BILINEAR(nw, ne, sw, se, at.fx, at.fy);
}

// m_{j+1}(p) from m_j(p) and the motion of frame t-j
static inline float2 chain_on(const float2 chained, global const float2 *earlier, const int x, const int y,
                              const int height, const int width)
{
    // A place far outside reads 0, and a motion that is not finite stays so; neither place fits in an integer.
    const bool near = chained.x >= (float)(-width - 1) && chained.x <= (float)(width + 1) && chained.y >= (float)(-height - 1) &&
                      chained.y <= (float)(height + 1);
    return chained + (near ? GATHER(earlier, lead(chained, x, y), height, width) : (float2)(0.0f));
}

kernel void motion_chain(global const float2 *restrict motions, global float2 *restrict motion, const int k, const int height,
                         const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    float2 chained = motions[pixel];
    for (int j = 1; j < k; ++j) chained = chain_on(chained, motions + j * height * width, x, y, height, width);
    motion[pixel] = chained;
}
