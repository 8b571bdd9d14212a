// SPDX-License-Identifier: MIT
// Stage occlusion_warp, reference stss_ref/occlusion_warp.py::occlusion_warp: four kernels, in this order.
//
//  buffer            dir     shape      unit
//  color             in      (H, W, 3)  the earlier frame, finite
//  warped            in      (H, W, 3)  the same after stage warp
//  motion            in      (H, W, 2)  px, current -> earlier; non-finite does not splat
//  depth             in      (H, W)     normalised, finite; at depth[pixel * depth_stride + depth_offset]
//  valid             in      (H, W)     1 = warped colour to be trusted
//  keys              in/out  (H, W)     smallest depth that landed here, as depth_key; UNWANTED: nobody asks
//  first             in/out  (H, W)     the first pixel of that depth in raster order; NOBODY
//  occlusion_motion  out     (H, W, 2)  px, current -> earlier
//  filled            out     (H, W, 3)  as color
//
// Two passes of 32-bit minima find the smallest (depth, raster index), which does not depend on the order of the writes.
// Reading before the atomic is safe: a stale value is only larger, and no depth's key is UNWANTED.
// Build: no options.  Launch (W, H) rounded up.
#include "sample.clh"

#define FARTHEST 10.0f  // where the depth buffer starts: what lies deeper never splats
#define UNWANTED 0u     // less than the key of any depth
#define NOBODY 0xffffffffu

// Unsigned integers in the order of the floats; -0 and 0 are one.
static inline uint depth_key(const float depth)
{
    const uint bits = as_uint(depth == 0.0f ? 0.0f : depth);
    return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

// The upper left of the four pixels that a motion lands on; outside the frame where it is not finite.
static inline int2 landing(const float2 motion, const int x, const int y, const int height, const int width)
{
    const Place at = follow(motion, x, y, height, width);
    return at.finite ? (int2)(at.x, at.y) : (int2)(-2);
}

static inline bool in_frame(const int x, const int y, const int height, const int width)
{
    return x >= 0 && x < width && y >= 0 && y < height;
}

// Motion of the nearest surface that covered an earlier pixel, 0 where none did.
static inline float2 splatted(global const float2 *motion, global const uint *first, const int earlier)
{
    const uint source = first[earlier];
    return source == NOBODY ? (float2)(0.0f) : motion[source];
}

// The earlier colour at p plus the occlusion motion: where to look instead.
static inline float3 look_instead(global const float *color, const float2 occlusion_motion, const int x, const int y,
                                  const int height, const int width)
{
    return bilinear3(color, taps(follow(occlusion_motion, x, y, height, width), height, width));
}

kernel void splat_clear(global uint *restrict keys, global uint *restrict first, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    keys[y * width + x] = depth_key(FARTHEST);
    first[y * width + x] = NOBODY;
}

// One pixel's part in the smallest depth of the four places that it lands on.
static inline void splat_depth(const float2 motion, const int x, const int y, global const float *depth,
                               volatile global uint *keys, const int height, const int width)
{
    const int2 at = landing(motion, x, y, height, width);
    for (int i = 0; i < 4; ++i) {
        const int u = at.x + (i & 1), v = at.y + (i >> 1);
        if (!in_frame(u, v, height, width)) continue;
        const uint present = keys[v * width + u];
        if (present == UNWANTED) continue;
        const uint key = depth_key(*depth);
        if (key < present) atomic_min(&keys[v * width + u], key);
    }
}

// One pixel's part in the first pixel of that depth.
static inline void splat_index(const float2 motion, const int x, const int y, global const float *depth,
                               global const uint *keys, volatile global uint *first, const int height,
                               const int width)
{
    const int2 at = landing(motion, x, y, height, width);
    const uint pixel = y * width + x;
    for (int i = 0; i < 4; ++i) {
        const int u = at.x + (i & 1), v = at.y + (i >> 1);
        if (!in_frame(u, v, height, width)) continue;
        const uint winner = keys[v * width + u];
        if (winner == UNWANTED || winner == depth_key(FARTHEST) || winner != depth_key(*depth)) continue;
        if (pixel < first[v * width + u]) atomic_min(&first[v * width + u], pixel);
    }
}

kernel void splat_nearest(global const float2 *restrict motion, global const float *restrict depth, const int depth_stride,
                          const int depth_offset, volatile global uint *restrict keys, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    splat_depth(motion[pixel], x, y, depth + pixel * depth_stride + depth_offset, keys, height, width);
}

kernel void splat_first(global const float2 *restrict motion, global const float *restrict depth, const int depth_stride,
                        const int depth_offset, global const uint *restrict keys, volatile global uint *restrict first,
                        const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    splat_index(motion[pixel], x, y, depth + pixel * depth_stride + depth_offset, keys, first, height, width);
}

kernel void occlusion_warp(global const float *restrict color, global const float *restrict warped,
                           global const float2 *restrict motion, global const uint *restrict first,
                           global const uchar *restrict valid, global float2 *restrict occlusion_motion,
                           global float *restrict filled, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    const Taps at = taps(follow(motion[pixel], x, y, height, width), height, width);
    const float2 instead = splatted(motion, first, at.nw);  // nw: the whole pixel, clamped into the frame
    occlusion_motion[pixel] = instead;
    vstore3(valid[pixel] ? read3(warped, pixel) : look_instead(color, instead, x, y, height, width), pixel, filled);
}
