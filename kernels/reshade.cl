// SPDX-License-Identifier: MIT
// Stage reshade, reference stss_ref/reshade.py::reshade: three kernels, in this order.
//
//  buffer             dir     shape      unit
//  color              in      (H, W, 3)  the earlier frame, finite
//  warped             in      (H, W, 3)  the same after stage warp
//  motion             in      (H, W, 2)  px, current -> earlier; non-finite leads to no sample
//  valid              in      (H, W)     1 = warped colour can be trusted
//  stencil_previous   in      (H, W)     object number of the earlier frame, 0 = static
//  stencil            in      (H, W)     object number
//  normal_previous    in      (H, W, 3)  world space
//  normal             in      (H, W, 3)  world space
//  position_previous  in      (H, W, 3)  cm; may be non-finite
//  position           in      (H, W, 3)  cm; may be non-finite
//  base_color         in      (H, W, 3)
//  samples            in/out  (H, W, 4)  for holes: the mean of their own samples and its number; others are not read
//  lights             in/out  (H, W, 4)  for holes: the light around and 1, or 0 without one; others are not read
//  filled             out     (H, W, 3)  as color, at least 0
//
// Build: no options.  Launch (W, H) rounded up.
#include "common.clh"
#include "reshade.clh"

kernel void find_samples(global const float *restrict color, global const float2 *restrict motion,
                         global const uchar *restrict valid, global const float *restrict stencil_previous,
                         global const float *restrict stencil, global const float *restrict normal_previous,
                         global const float *restrict normal, global const float *restrict position_previous,
                         global const float *restrict position, global float4 *restrict samples, const int height,
                         const int width)
{
    const int x = get_global_id(0), y = get_global_id(1), pixel = y * width + x;
    if (x >= width || y >= height || valid[pixel]) return;
    const Surfaces s = {height,   width, 3, 3, stencil_previous, stencil, normal_previous, normal, position_previous,
                        position, 0};
    samples[pixel] = own_samples(s, color, motion[pixel], x, y);
}

kernel void find_lights(global const float *restrict warped, global const uchar *restrict valid,
                        global const float *restrict stencil, global const float *restrict normal,
                        global const float *restrict base_color, global const float4 *restrict samples,
                        global float4 *restrict lights, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1), pixel = y * width + x;
    if (x >= width || y >= height || valid[pixel]) return;
    const Surfaces s = {height, width, 3, 3, 0, stencil, 0, normal, 0, 0, base_color};
    Light light = no_light(s, pixel);
    for (int step = 1; step <= LARGEST_STEP && !is_own(samples[pixel], stencil[pixel]); step *= 2)
        for (int j = -REACH; j <= REACH; ++j)
            for (int i = -REACH; i <= REACH; i += place_stride(j)) {
                const int u = x + step * i, v = y + step * j;
                if (u < 0 || u >= width || v < 0 || v >= height) continue;
                const int other = v * width + u;
                if (stencil[other] != stencil[pixel] || !(valid[other] || samples[other].w > 0.0f)) continue;
                add_source(&light, s, other, (u - x) * (u - x) + (v - y) * (v - y),
                           valid[other] ? not_negative(read3(warped, other)) : samples[other].xyz);
            }
    lights[pixel] = light_of(light);
}

kernel void reshade(global const float *restrict warped, global const uchar *restrict valid,
                    global const float *restrict stencil, global const float *restrict normal,
                    global const float *restrict base_color, global const float4 *restrict samples,
                    global const float4 *restrict lights, global float *restrict filled, const int height,
                    const int width)
{
    const int x = get_global_id(0), y = get_global_id(1), pixel = y * width + x;
    if (x >= width || y >= height) return;
    float3 c = not_negative(read3(warped, pixel));
    if (!valid[pixel]) {
        const Surfaces s = {height, width, 3, 3, 0, stencil, 0, normal, 0, 0, base_color};
        if (samples[pixel].w > 0.0f) c = samples[pixel].xyz;
        if (lights[pixel].w > 0.0f) c = lit(s, valid, lights, x, y);
    }
    vstore3(c, pixel, filled);
}
