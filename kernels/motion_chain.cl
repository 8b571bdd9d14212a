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

// p + m(p); anything beyond the frame's neighbourhood, NaN too, is moved to two pixels before its corner.
static inline float2 chain_position(const float2 chained, const int x, const int y, const int height, const int width)
{
    const float2 at = (float2)(x, y) + chained;
    const bool near = at.x > -2.0f && at.x < (float)(width + 1) && at.y > -2.0f && at.y < (float)(height + 1);
    return near ? at : (float2)(-2.0f);
}

// motion at a whole pixel, 0 outside the frame
static inline float2 read_motion(global const float2 *motion, const int x, const int y, const int height, const int width)
{
    return x >= 0 && x < width && y >= 0 && y < height ? motion[y * width + x] : (float2)(0.0f);
}

static inline float2 gather_longest(global const float2 *motion, const float2 chained, const int x, const int y,
                                    const int height, const int width)
{
    // A pixel outside the frame is 0, and a 0 among the four wins. Comparisons are false for NaN; trunc goes towards zero, and
    // takes positions down to -1 to pixel 0, which has no right or lower neighbour in a frame one pixel wide or high.
    const float2 at = (float2)(x, y) + chained;
    const bool inside = at.x > -1.0f && at.x < (float)(width - 1) && at.y > -1.0f && at.y < (float)(height - 1);
    if (!inside || width == 1 || height == 1) return (float2)(0.0f);
    global const float2 *restrict corner = motion + (int)at.y * width + (int)at.x;
    const float4 top = read4(corner), bottom = read4(corner + width);
    const float4 u = (float4)(top.xz, bottom.xz), v = (float4)(top.yw, bottom.yw);
    const int4 still = u == 0.0f && v == 0.0f;
    if (still.x | still.y | still.z | still.w) return (float2)(0.0f);
    const float4 squared = u * u + v * v, length = squared < INFINITY ? squared : (float4)(INFINITY);  // NaN is the longest, too
    // Replaced only by one strictly longer: the first in raster order stays.
    const int4 eastern = length.yyww > length.xxzz;
    const float4 longest = eastern ? (float4)(top.zw, bottom.zw) : (float4)(top.xy, bottom.xy);
    const float4 of = eastern ? length.yyww : length.xxzz;
    return of.zw > of.xy ? longest.zw : longest.xy;
}

static inline float2 gather_nearest(global const float2 *motion, const float2 chained, const int x, const int y,
                                    const int height, const int width)
{
    const float2 at = chain_position(chained, x, y, height, width) + 0.5f;
    return read_motion(motion, floor_int(at.x), floor_int(at.y), height, width);
}

static inline float2 gather_bilinear(global const float2 *motion, const float2 chained, const int x, const int y,
                                     const int height, const int width)
{
    const float2 at = chain_position(chained, x, y, height, width);
    const int left = floor_int(at.x), top = floor_int(at.y);
    const float fx = at.x - (float)left, fy = at.y - (float)top;
    const float2 nw = read_motion(motion, left, top, height, width), ne = read_motion(motion, left + 1, top, height, width);
    const float2 sw = read_motion(motion, left, top + 1, height, width), se = read_motion(motion, left + 1, top + 1, height, width);
    return BILINEAR(nw, ne, sw, se, fx, fy);
}

// m_{j+1}(p) from m_j(p) and the motion of frame t-j
static inline float2 chain_on(const float2 chained, global const float2 *earlier, const int x, const int y,
                              const int height, const int width)
{
    return chained + GATHER(earlier, chained, x, y, height, width);
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
