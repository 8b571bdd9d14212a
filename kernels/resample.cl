// Building block resample: x2 with corners aligned, reference stss_ref/resample.py::upsample_corners.
//
//  buffer  dir  shape               content
//  in      in   padded, (CHANNELS)  see common.clh
//  out     out  padded, (CHANNELS)  twice the size
//
// Output o of N = 2n reads input position o (n - 1) / (N - 1): an integer quotient and its remainder, so that the weight is rounded
// once however large the frame. The buffers may hold a strip of the frame: their row 0 is row `top` of `full_height` (2 `top` of the
// output).
// Build -D CHANNELS=n (multiple of 8), optionally -D HALF.  Launch (2 width, 2 height).
#ifndef CHANNELS
#error "resample.cl needs -D CHANNELS=n"
#endif
#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define CHANNELS8 (CHANNELS / 8)

kernel void upsample_corners(global const stored *restrict in, global stored *restrict out, const int height, const int width,
                             const int in_columns, const int out_columns, const int full_height, const int top)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= 2 * width || y >= 2 * height) return;
    const int along_x = x * (width - 1), along_y = (2 * top + y) * (full_height - 1);
    const int x0 = along_x / (2 * width - 1), row = along_y / (2 * full_height - 1);
    const int y0 = min(max(row - top, 0), height - 1);
    const float fx = (along_x - x0 * (2 * width - 1)) / (2 * width - 1.0f);
    const float fy = (along_y - row * (2 * full_height - 1)) / (2 * full_height - 1.0f);
    const int x1 = min(x0 + 1, width - 1), y1 = min(y0 + 1, height - 1);
    const int upper = (y0 + 1) * in_columns + 1, lower = (y1 + 1) * in_columns + 1;
    for (int c = 0; c < CHANNELS8; ++c) {
        const float8 nw = LOAD8(in, (upper + x0) * CHANNELS8 + c), ne = LOAD8(in, (upper + x1) * CHANNELS8 + c);
        const float8 sw = LOAD8(in, (lower + x0) * CHANNELS8 + c), se = LOAD8(in, (lower + x1) * CHANNELS8 + c);
        // First down, then across, as the reference.
        const float8 west = nw + (sw - nw) * fy, east = ne + (se - ne) * fy;
        STORE8(west + (east - west) * fx, ((y + 1) * out_columns + x + 1) * CHANNELS8 + c, out);
    }
}
