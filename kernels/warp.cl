// SPDX-License-Identifier: MIT
// Stage warp, reference stss_ref/warp.py::warp.
//
//  buffer  dir  shape             unit
//  color   in   (H, W, CHANNELS)  the earlier frame; any unit, finite
//  motion  in   (H, W, 2)         px, current -> earlier, x right, y down; non-finite reads the pixel itself
//  warped  out  (H, W, CHANNELS)  as color; border pixel where outside
//  inside  out  (H, W)            1 = motion finite and the place read lies within the frame
//
// Build -D CHANNELS=n.  Launch (W, H) rounded up.  No image sampler, since each device chooses its precision.
#ifndef CHANNELS
#error "warp.cl needs -D CHANNELS=n"
#endif
#include "sample.clh"

kernel void warp(global const float *restrict color, global const float2 *restrict motion,
                 global float *restrict warped, global uchar *restrict inside, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    const Place place = follow(motion[pixel], x, y, height, width);
    inside[pixel] = leads_inside(place, height, width);
    bilinear_all(color, taps(place, height, width), CHANNELS, warped + pixel * CHANNELS);
}
