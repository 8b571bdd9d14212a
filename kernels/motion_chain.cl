// SPDX-License-Identifier: MIT
// Stage motion_chain, reference stss_ref/motion_chain.py::motion_chain.
//
//  buffer   dir  shape            unit
//  motions  in   (k, H, W, 2)     px, frames t, t-1, ..., newest first, each to the frame before it; may be non-finite
//  motion   out  (H, W, 2)        px, frame t to frame t-k
//
// Kernel motion_of_two is for k = 2 with the motions in two buffers, `newer` and `older`.
//
// Launch (W, H) rounded up.
#include "motion_chain.clh"

kernel void motion_chain(global const float2 *restrict motions, global float2 *restrict motion, const int k,
                         const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    float2 chained = motions[pixel];
    for (int j = 1; j < k; ++j) chained = chain_on(chained, motions + j * height * width, x, y, height, width);
    motion[pixel] = chained;
}

kernel void motion_of_two(global const float2 *restrict newer, global const float2 *restrict older,
                          global float2 *restrict motion, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    motion[pixel] = chain_on(newer[pixel], older, x, y, height, width);
}
