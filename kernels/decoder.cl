// Stage decoder, its output: reference stss_ref/decoder.py (outc), stss_ref/resample.py::pixel_shuffle and ::upsample_centres.
//
//  buffer   dir  shape           content
//  feature  in   padded, (24)    up3's result
//  color    in   (H8, W8, 4)     see decoder.clh, as weight and bias
//  image    out  (2H, 2W, 3)     what lies beyond 2H, 2W is not written
//
// The buffers may hold a strip of the frame: their row 0 is the frame's row `top`; rows from `first_row` on are written.
//
// Build -D STRIP (pixels of one work-item, a multiple of 4) -D GROUP (work-group along x), optionally -D HALF.  Launch (ceil(W / STRIP), rows to write).
// winograd.cl -D IMAGE does the same at the end of up3.
// -D SKIP: only pixels that a change reaches, see change_map.clh; the last arguments are the maps of feature and color.
// -D WANTED: tiles that the map `wanted` does not mark are upsampled alone; see flat_tiles.cl.
#if !defined(STRIP) || !defined(GROUP)
#error "decoder.cl needs -D STRIP, GROUP"
#endif
#include "common.clh"
#ifdef SKIP
#include "change_map.clh"
#endif
#include "decoder.clh"

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void image(global const stored *restrict feature, global const float4 *restrict color, global const float8 *restrict weight,
           global const float8 *restrict bias, global float *restrict image, const int width, const int rows, const int columns,
           const int feature_columns, const int first_row, const int top
#ifdef SKIP
           , global const uchar *restrict feature_changes, global const uchar *restrict color_changes
#elif defined(WANTED)
           , global const uchar *restrict wanted
#endif
           )
{
    const int y = first_row + get_global_id(1), first = get_global_id(0) * STRIP, last = min(first + STRIP, width);
    for (int x = first; x < last; x += 4) {
#ifdef SKIP
        const int high = rows / 4, wide = columns / 4;
        if (!feature_changes[y / 4 * wide + x / 4] && !marked(color_changes, high, wide, y - 1, y + 1, x - 1, x + 4)) continue;
#endif
        float8 f[12], sums[8];
#ifdef WANTED
        if (!wanted[y / 4 * (columns / 4) + x / 4]) {
            for (int i = 0; i < 8; ++i) sums[i] = 0.0f;
            write_pixels(sums, color, image, y, x, last, width, rows, columns, top);
            continue;
        }
#endif
        // Beyond the row lie zeros or the next one: computed, not written.
        for (int c = 0; c < 12; ++c) f[c] = LOAD8(feature, ((y + 1) * feature_columns + x + 1) * 3 + c);
        residual((const float *)f, weight, bias, sums);
        write_pixels(sums, color, image, y, x, last, width, rows, columns, top);
    }
}
