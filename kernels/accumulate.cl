// SPDX-License-Identifier: MIT
// Stage accumulate, reference stss_ref/accumulate.py::accumulate.
//
//  buffer  dir  shape        unit
//  image   in   (2H, 2W, 3)  stage frame's; finite
//  before  in   (2H, 2W, 3)  shown for the display frame before
//  motion  in   (H, W, 2)    px, current -> previous; non-finite is off screen
//  shown   out  (2H, 2W, 3)  SHARE of before where motion leads into the frame, the rest of image
//
// Build -D SHARE.  Launch (W, H) rounded up: a work-item makes the 2 x 2 display pixels of a pixel, which share its motion.
#ifndef SHARE
#error "accumulate.cl needs -D SHARE"
#endif
#include "sample.clh"

// A row of four display pixels, the outer ones clamped into the frame: their smallest and largest values in each
// channel around the second and around the third, and these two themselves.
typedef struct {
    float3 low[2], high[2], here[2];
} Row;

INLINE float3 least3(const float3 a, const float3 b)
{
    return a < b ? a : b;
}

INLINE float3 most3(const float3 a, const float3 b)
{
    return a > b ? a : b;
}

INLINE Row read_row(global const float *image, const int west, const int at, const int east)
{
    const float3 w = read3(image, west), a = read3(image, at), b = read3(image, at + 1), e = read3(image, east);
    const float3 low = least3(a, b), high = most3(a, b);
    const Row row = {{least3(w, low), least3(low, e)}, {most3(w, high), most3(high, e)}, {a, b}};
    return row;
}

kernel void accumulate(global const float *restrict image, global const float *restrict before,
                       global const float2 *restrict motion, global float *restrict shown, const int height,
                       const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int rows = 2 * height, columns = 2 * width, west = x ? 2 * x - 1 : 0,
              east = x < width - 1 ? 2 * x + 2 : 2 * x + 1;
    const float2 moved = 2.0f * motion[y * width + x];
    Row row[4];
#pragma unroll
    for (int j = 0; j < 4; ++j) {
        const int at = 2 * y - 1 + j, line = (at < 0 ? 0 : at < rows ? at : rows - 1) * columns;
        row[j] = read_row(image, line + west, line + 2 * x, line + east);
    }
#pragma unroll
    for (int j = 0; j < 2; ++j)
#pragma unroll
        for (int i = 0; i < 2; ++i) {
            const Place place = follow(moved, 2 * x + i, 2 * y + j, rows, columns);
            const float3 low = least3(least3(row[j].low[i], row[j + 1].low[i]), row[j + 2].low[i]);
            const float3 high = most3(most3(row[j].high[i], row[j + 1].high[i]), row[j + 2].high[i]);
            const float3 here = row[j + 1].here[i];
            const float3 history = most3(low, least3(high, bilinear3(before, taps(place, rows, columns))));
            const float3 mean = LERP(here, history, SHARE);
            const bool inside = leads_inside(place, rows, columns);
            global float *restrict out = shown + ((2 * y + j) * columns + 2 * x + i) * 3;
            out[0] = inside ? mean.x : here.x;
            out[1] = inside ? mean.y : here.y;
            out[2] = inside ? mean.z : here.z;
        }
}
