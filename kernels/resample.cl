// Building block resample: x2 with corners aligned, reference stss_ref/resample.py::upsample_corners.
//
//  buffer  dir  shape               content
//  in      in   padded, (8 eights)  see common.clh
//  out     out  padded, (8 eights)  twice the size
//
// Output o of N = 2n reads input position o (n - 1) / (N - 1): an integer quotient and its remainder, so that the weight is rounded
// once however large the frame. The buffers may hold a strip of the frame: their row 0 is row `top` of `full_height` (2 `top` of the
// output).
// Build optionally -D HALF.  Launch (2 width, 2 height), or more.
//
// -D SKIP -D SPAN (tiles of a work-item): only tiles that a change reaches, see change_map.clh; in_changes, changes are the maps of
// in and out, `top` is 0. -D WANTED=n in its place: only tiles no farther than n tiles from one that the map `wanted` of out marks. Launch (ceil(width / 2 / SPAN), ceil(height / 2)).
#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"
#if defined(SKIP) || defined(WANTED)
#include "change_map.clh"
#endif

// Output pixel (y, x); whether it came to differ.
static inline int corners(global const stored *restrict in, global stored *restrict out, const int height, const int width,
                          const int in_columns, const int out_columns, const int full_height, const int top,
                          const int eights, const int x, const int y, const float tolerance)
{
    const int along_x = x * (width - 1), along_y = (2 * top + y) * (full_height - 1);
    const int x0 = along_x / (2 * width - 1), row = along_y / (2 * full_height - 1);
    const int y0 = min(max(row - top, 0), height - 1);
    const float fx = (along_x - x0 * (2 * width - 1)) / (2 * width - 1.0f);
    const float fy = (along_y - row * (2 * full_height - 1)) / (2 * full_height - 1.0f);
    const int x1 = min(x0 + 1, width - 1), y1 = min(y0 + 1, height - 1);
    const int upper = (y0 + 1) * in_columns + 1, lower = (y1 + 1) * in_columns + 1;
#ifdef SKIP
    stored8 differs = 0;
#endif
    for (int c = 0; c < eights; ++c) {
        const float8 nw = LOAD8(in, (upper + x0) * eights + c), ne = LOAD8(in, (upper + x1) * eights + c);
        const float8 sw = LOAD8(in, (lower + x0) * eights + c), se = LOAD8(in, (lower + x1) * eights + c);
        // First down, then across, as the reference.
        const float8 west = nw + (sw - nw) * fy, east = ne + (se - ne) * fy;
#ifdef SKIP
        differs |= replace8(west + (east - west) * fx, ((y + 1) * out_columns + x + 1) * eights + c, out, tolerance);
    }
    return any_bit(differs);
#else
        STORE8(west + (east - west) * fx, ((y + 1) * out_columns + x + 1) * eights + c, out);
    }
    return 1;
#endif
}

kernel void upsample_corners(global const stored *restrict in, global stored *restrict out, const int height, const int width,
                             const int in_columns, const int out_columns, const int full_height, const int top, const int eights
#ifdef SKIP
                             , global const uchar *restrict in_changes, global uchar *restrict changes, const float tolerance
#elif defined(WANTED)
                             , global const uchar *restrict wanted
#endif
                             )
{
#if defined(WANTED)
    const int tiles_down = (2 * height + 3) / 4, tiles_across = (out_columns - 2) / 4;
    const int first = get_global_id(0) * SPAN, last = min(first + SPAN, tiles_across) - 1, tile_y = get_global_id(1);
    const int north = max(tile_y - WANTED, 0), south = min(tile_y + WANTED, tiles_down - 1);
    for (int t = first; t <= last; ++t) {
        if (!marked_tiles(wanted, tiles_across, north, south, max(t - WANTED, 0), min(t + WANTED, tiles_across - 1))) continue;
        for (int y = 4 * tile_y; y < min(4 * tile_y + 4, 2 * height); ++y)
            for (int x = 4 * t; x < min(4 * t + 4, 2 * width); ++x)
                corners(in, out, height, width, in_columns, out_columns, full_height, top, eights, x, y, 0.0f);
    }
#elif defined(SKIP)
    const int rows = (height + 3) / 4, columns = (in_columns - 2) / 4, out_tiles = (out_columns - 2) / 4;
    const int first = get_global_id(0) * SPAN, last = min(first + SPAN, out_tiles) - 1, tile_y = get_global_id(1);
    // Rows 4 t .. 4 t + 3 of the output read the input's rows 2 t - 1 .. 2 t + 2.
    if (!marked(in_changes, rows, columns, 2 * tile_y - 1, 2 * tile_y + 2, 2 * first - 1, 2 * last + 2)) return;
    int reached[SPAN], differs[SPAN];
    for (int i = 0; i <= last - first; ++i) {
        const int west = 2 * (first + i) - 1;
        reached[i] = marked(in_changes, rows, columns, 2 * tile_y - 1, 2 * tile_y + 2, west, west + 3);
        differs[i] = 0;
    }
    // Row by row: neighbours in memory one after the other.
    for (int y = 4 * tile_y; y < min(4 * tile_y + 4, 2 * height); ++y)
        for (int i = 0; i <= last - first; ++i) {
            if (!reached[i]) continue;
            for (int x = 4 * (first + i); x < min(4 * (first + i) + 4, 2 * width); ++x)
                differs[i] |= corners(in, out, height, width, in_columns, out_columns, full_height, top, eights, x, y, tolerance);
        }
    for (int i = 0; i <= last - first; ++i)
        if (differs[i]) changes[tile_y * out_tiles + first + i] = 1;
#else
    const int x = get_global_id(0), y = get_global_id(1);
    if (x < 2 * width && y < 2 * height)
        corners(in, out, height, width, in_columns, out_columns, full_height, top, eights, x, y, 0.0f);
#endif
}
