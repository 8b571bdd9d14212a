// SPDX-License-Identifier: MIT
// Stage erm, its input at 1/8 size, reference stss_ref/resample.py::downsample_8 and ::pad_to_8.
//
//  buffer    dir  shape             content
//  gbuffer   in   (H, W, 9)         normal 3, depth, roughness, metallic, base colour 3
//  mask      in   (H, W) of MASK    1 = can be trusted
//  eighth    out  padded, (16)      both at 1/8 size: gbuffer 9, mask, zeros 6
//
// `dirty` (H / 4, W / 4, rounded up to whole eights of pixels): if MARKS(changes), only pixels with a dirty tile are
// computed.
// `height`, `width`: of the frame; `down`, `across`: of `eighth`, whose row 0 is the frame's row `top`.
// Build -D MASK=float or uchar, optionally -D STORED.  Launch (across, down), or more.
//
// If MARKS(changes), the output's map, a value is compared with the stored one, and marked if bits differ
// (change_map.clh).
#ifndef MASK
#error "downsample_8.cl needs -D MASK"
#endif
#include "common.clh"
#include "tile_list.clh"

// The mean of pixels 8i + 3 and 8i + 4 along each axis; beyond the frame its last row and column are repeated
// (pad_to_8).
kernel void downsample_8(global const float *restrict gbuffer, global const MASK *restrict mask,
                         global stored *restrict eighth, const int height, const int width, const int down,
                         const int across, const int columns, const int top, global uchar *restrict changes,
                         global const uchar *restrict dirty)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= across || y >= down) return;
    global const uchar *upper = dirty + 4 * y * across + 2 * x, *lower = upper + 2 * across;
    if (MARKS(changes) && !(upper[0] | upper[1] | lower[0] | lower[1])) return;
    const int west = min(8 * x + 3, width - 1), east = min(8 * x + 4, width - 1);
    const int north = min(top + 8 * y + 3, height - 1) * width, south = min(top + 8 * y + 4, height - 1) * width;
    const int nw = north + west, ne = north + east, sw = south + west, se = south + east;
    float mean[16] __attribute__((aligned(32)));
    for (int c = 0; c < 9; ++c) {
        const float left = (gbuffer[9 * nw + c] + gbuffer[9 * sw + c]) * 0.5f;
        mean[c] = (left + (gbuffer[9 * ne + c] + gbuffer[9 * se + c]) * 0.5f) * 0.5f;
    }
    mean[9] = (((float)mask[nw] + (float)mask[sw]) * 0.5f + ((float)mask[ne] + (float)mask[se]) * 0.5f) * 0.5f;
    for (int c = 10; c < 16; ++c) mean[c] = 0.0f;
    const int to = ((y + 1) * columns + x + 1) * 2;
    BEGIN_PIXEL;
    PUT(((const float8 *)mean)[0], to, eighth);
    PUT(((const float8 *)mean)[1], to + 1, eighth);
    END_PIXEL(y * (columns - 2) + x);
}
