// SPDX-License-Identifier: MIT
// Stage occlusion_warp, reference stss_ref/occlusion_warp.py::occlusion_warp: four kernels, in this order.
//
//  buffer            dir     shape      unit
//  color             in      (H, W, 3)  the earlier frame, finite
//  warped            in      (H, W, 3)  the same after stage warp
//  motion            in      (H, W, 2)  px, current -> earlier; non-finite does not splat
//  depth             in      (H, W)     normalised, finite
//  valid             in      (H, W)     1 = warped colour can be trusted
//  keys              in/out  (H, W)     smallest depth that landed here, as depth_key; UNWANTED: no hole reads this
//                                     place
//  first             in/out  (H, W)     the first pixel of that depth in raster order; NO_PIXEL
//  occlusion_motion  out     (H, W, 2)  px, current -> earlier
//  filled            out     (H, W, 3)  as color
//
// Build: no options.  Launch (W, H) rounded up.
#include "occlusion_warp.clh"

kernel void splat_clear(global uint *restrict keys, global uint *restrict first, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    keys[y * width + x] = depth_key(FARTHEST);
    first[y * width + x] = NO_PIXEL;
}

kernel void splat_nearest(global const float2 *restrict motion, global const float *restrict depth,
                          volatile global uint *restrict keys, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    splat_depth(motion[pixel], x, y, depth + pixel, keys, height, width);
}

kernel void splat_first(global const float2 *restrict motion, global const float *restrict depth,
                        global const uint *restrict keys, volatile global uint *restrict first, const int height,
                        const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    splat_index(motion[pixel], x, y, depth + pixel, keys, first, height, width);
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
