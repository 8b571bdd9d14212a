// SPDX-License-Identifier: MIT
// Building block arrive for GPUs, one launch for each new display frame: finds where it differs, and whether all values
// are finite; changed_tiles.cl is the same for processors; reference stss_ref/arrays.py::require_finite.
//
//  buffer           dir  shape        unit
//  motion           in   (H, W, 2)    px
//  gbuffer          in   (H, W, 9)
//  nov, stencil     in   (H, W)
//  position         in   (H, W, 3)
//  color            in   (H, W, 3)    read if `has_color`
//  *_before         in   likewise     of the previous frame, read if `compares`; color_before: of the last frame with a
//                                     colour, if `recolors`
//  bad              out  (4)          set to 1 if a value of color (0), gbuffer (1), nov (2) or stencil (3) is not
//                                     finite; the caller clears it
//  differs          out  (H/4, W/4)   of each tile of 4 x 4 pixels, sizes rounded up; if `compares`: CHANGED: something
//                                     moves in it, or one of its bits differs; RECOLORED: a bit of the colour, if there
//                                     is one, differs
//
// Work-group (128): it takes TILES_ACROSS tiles of a row of tiles, reading values in their order in memory.  Launch
// (128 ceil(W / 4 / TILES_ACROSS), H / 4).
#include "arrive.clh"

#define ITEMS 128
#define TILES_ACROSS 16
#define EXPONENT 0x7f800000u

// Reads the four rows of pixels of the group's tiles; finds values that are not finite, and tiles with a bit that
// differs from `before`.
static inline uint look(global const uint *now, global const uint *before, const int floats, const int y, const int x,
                        const int height, const int width, const int compares, local uint *seen)
{
    const int item = get_local_id(0), count = min(4 * TILES_ACROSS, width - x) * floats;
    uint bad = 0;
    for (int row = y; row < min(y + 4, height); ++row) {
        const int first = (row * width + x) * floats;
        for (int i = item; i < count; i += ITEMS) {
            const uint value = now[first + i];
            bad |= (value & EXPONENT) == EXPONENT;
            if (compares && value != before[first + i]) atomic_or(seen + i / (4 * floats), 1u);
        }
    }
    return bad;
}

kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void arrive(
    global const uint *restrict motion, global const uint *restrict gbuffer, global const uint *restrict nov,
    global const uint *restrict stencil, global const uint *restrict position, global const uint *restrict color,
    global const uint *restrict gbuffer_before, global const uint *restrict nov_before,
    global const uint *restrict stencil_before, global const uint *restrict position_before,
    global const uint *restrict color_before, global int *restrict bad, global uchar *restrict differs,
    const Arrival arrival)
{
    const int height = arrival.height, width = arrival.width;
    local uint seen[TILES_ACROSS], colored[TILES_ACROSS];
    const int item = get_local_id(0), columns = (width + 3) / 4, first = get_group_id(0) * TILES_ACROSS,
              y = 4 * get_group_id(1), x = 4 * first;
    if (item < TILES_ACROSS) seen[item] = colored[item] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (arrival.compares)
        for (int row = y; row < min(y + 4, height); ++row)
            for (int i = item; i < 2 * min(4 * TILES_ACROSS, width - x); i += ITEMS)
                if (motion[2 * (row * width + x) + i] << 1) atomic_or(seen + i / 8, 1u);  // -0 is no motion
    const uint g_bad = look(gbuffer, gbuffer_before, 9, y, x, height, width, arrival.compares, seen);
    const uint n_bad = look(nov, nov_before, 1, y, x, height, width, arrival.compares, seen);
    const uint s_bad = look(stencil, stencil_before, 1, y, x, height, width, arrival.compares, seen);
    if (arrival.compares) look(position, position_before, 3, y, x, height, width, 1, seen);
    const uint c_bad =
        arrival.has_color ? look(color, color_before, 3, y, x, height, width, arrival.recolors, colored) : 0;
    if (c_bad) atomic_or(bad, 1);
    if (g_bad) atomic_or(bad + 1, 1);
    if (n_bad) atomic_or(bad + 2, 1);
    if (s_bad) atomic_or(bad + 3, 1);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (arrival.compares && item < TILES_ACROSS && first + item < columns) {
        differs[get_group_id(1) * columns + first + item] =
            (seen[item] ? CHANGED : 0) | (colored[item] ? RECOLORED : 0);
    }
}
