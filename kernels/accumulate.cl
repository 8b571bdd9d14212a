// SPDX-License-Identifier: MIT
// Stage accumulate, reference stss_ref/accumulate.py::accumulate.
//
//  buffer    dir  shape        unit
//  image     in   (2H, 2W, 3)  stage frame's; finite
//  newer     in   (2H, 2W, 3)  the same of the display frame before
//  older     in   (2H, 2W, 3)  of the one before that; not read if count is 1
//  to_newer  in   (H, W, 2)    px, current -> newer; non-finite is off screen
//  to_older  in   (H, W, 2)    px, current -> older; not read if count is 1
//  shown     out  (2H, 2W, 3)  the shares of the earlier images where motion leads into them, else of image
//
// Build -D NEWER_SHARE -D OLDER_SHARE -D SLOW (px).  Launch (W, H) rounded up: a work-item makes the 2 x 2 display
// pixels of a pixel, which share its motion.
#if !defined NEWER_SHARE || !defined OLDER_SHARE || !defined SLOW
#error "accumulate.cl needs -D NEWER_SHARE -D OLDER_SHARE -D SLOW"
#endif
#include "sample.clh"

// Two display pixels side by side: their three channels in the first six lanes.
typedef float8 Two;
typedef float8 two_anywhere __attribute__((aligned(4)));

INLINE Two least(const Two a, const Two b)
{
    return a < b ? a : b;
}

INLINE Two most(const Two a, const Two b)
{
    return a > b ? a : b;
}

INLINE int clamp_index(const int i, const int size)
{
    return i < 0 ? 0 : i < size ? i : size - 1;
}

// Pixels x and x + 1 of row y, each clamped into the frame. Inner: no pixel up to x + 2 needs that; eight numbers are
// read at once. A constant at each call, so that the pixels of the middle, nearly all, have no tests.
INLINE Two read_two(global const float *image, const int x, const int y, const int rows, const int columns,
                    const bool inner)
{
    if (inner) return *(global const two_anywhere *)(image + (y * columns + x) * 3);
    global const float *restrict line = image + clamp_index(y, rows) * columns * 3;
    return (Two)(read3(line, clamp_index(x, columns)), read3(line, clamp_index(x + 1, columns)), 0.0f, 0.0f);
}

// Two pixels of a row, and the smallest and the largest values around each.
typedef struct {
    Two low, high, here;
} Box;

INLINE Box box_of_row(global const float *image, const int x, const int y, const int rows, const int columns,
                      const bool inner)
{
    const Two west = read_two(image, x - 1, y, rows, columns, inner),
              here = read_two(image, x, y, rows, columns, inner),
              east = read_two(image, x + 1, y, rows, columns, inner);
    const Box box = {least(west, least(here, east)), most(west, most(here, east)), here};
    return box;
}

INLINE Box join(const Box above, const Box row, const Box below)
{
    const Box box = {least(above.low, least(row.low, below.low)), most(above.high, most(row.high, below.high)),
                     row.here};
    return box;
}

// The 2 x 2 display pixels of a pixel.
typedef struct {
    Box top, bottom;
} Boxes;

INLINE Boxes boxes_of(global const float *image, const int x, const int y, const int rows, const int columns,
                      const bool inner)
{
    const Box above = box_of_row(image, x, y - 1, rows, columns, inner),
              top = box_of_row(image, x, y, rows, columns, inner),
              bottom = box_of_row(image, x, y + 1, rows, columns, inner),
              below = box_of_row(image, x, y + 2, rows, columns, inner);
    const Boxes boxes = {join(above, top, bottom), join(top, bottom, below)};
    return boxes;
}

// The differences of an earlier image, moved and clamped into the boxes, from the four pixels.
typedef struct {
    Two top, bottom;
} Apart;

// A row of the earlier image between its pixels.
INLINE Two across(global const float *earlier, const Place at, const int below, const int rows, const int columns,
                  const bool inner)
{
    const Two west = read_two(earlier, at.x, at.y + below, rows, columns, inner),
              east = read_two(earlier, at.x + 1, at.y + below, rows, columns, inner);
    return LERP(west, east, at.fx);
}

INLINE Apart apart(global const float *earlier, const Place at, const Boxes boxes, const int rows, const int columns,
                   const bool inner)
{
    const Two first = across(earlier, at, 0, rows, columns, inner),
              second = across(earlier, at, 1, rows, columns, inner),
              third = across(earlier, at, 2, rows, columns, inner);
    const Two top = LERP(first, second, at.fy), bottom = LERP(second, third, at.fy);
    const Apart off = {most(boxes.top.low, least(boxes.top.high, top)) - boxes.top.here,
                       most(boxes.bottom.low, least(boxes.bottom.high, bottom)) - boxes.bottom.here};
    return off;
}

// All bits of two pixels, where the place lies in the frame; `at` is the left one's.
INLINE int8 are_inside(const Place at, const int rows, const int columns)
{
    Place east = at;
    east.x += 1;
    const int a = -leads_inside(at, rows, columns), b = -leads_inside(east, rows, columns);
    return (int8)(a, a, a, b, b, b, 0, 0);
}

// The part of its share that an earlier image keeps. Where motion is NaN it leads out of the frame, and nothing reads
// this.
INLINE float slowness(const float2 motion)
{
    return SLOW * SLOW / fmax(dot(motion, motion), SLOW * SLOW);
}

INLINE Apart apart_where_inside(global const float *earlier, const float2 motion, const int x, const int y,
                                const Boxes boxes, const int rows, const int columns, const float share)
{
    const Place at = follow(2.0f * motion, x, y, rows, columns);
    const bool inner = at.finite && at.x >= 0 && at.x + 3 < columns && at.y >= 0 && at.y + 2 < rows;
    Place below = at;
    below.y += 1;
    Apart off =
        inner ? apart(earlier, at, boxes, rows, columns, true) : apart(earlier, at, boxes, rows, columns, false);
    const float weight = share * slowness(motion);
    off.top *= weight;
    off.bottom *= weight;
    if (inner) return off;
    off.top = are_inside(at, rows, columns) ? off.top : (Two)(0.0f);
    off.bottom = are_inside(below, rows, columns) ? off.bottom : (Two)(0.0f);
    return off;
}

INLINE void write_two(global float *shown, const Two pixels)
{
    *(global float4_anywhere *)shown = pixels.lo;
    *(global float2_anywhere *)(shown + 4) = pixels.s45;
}

kernel void accumulate(global const float *restrict image, global const float *restrict newer,
                       global const float *restrict older, global const float2 *restrict to_newer,
                       global const float2 *restrict to_older, global float *restrict shown, const int count,
                       const int height, const int width)
{
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= width || row >= height) return;
    const int rows = 2 * height, columns = 2 * width, x = 2 * column, y = 2 * row, pixel = row * width + column;
    const bool inner = column > 0 && column < width - 1 && row > 0 && row < height - 1;
    const Boxes boxes =
        inner ? boxes_of(image, x, y, rows, columns, true) : boxes_of(image, x, y, rows, columns, false);
    Apart off = apart_where_inside(newer, to_newer[pixel], x, y, boxes, rows, columns, NEWER_SHARE);
    if (count > 1) {
        const Apart more = apart_where_inside(older, to_older[pixel], x, y, boxes, rows, columns, OLDER_SHARE);
        off.top += more.top;
        off.bottom += more.bottom;
    }
    global float *restrict out = shown + (y * columns + x) * 3;
    write_two(out, boxes.top.here + off.top);
    write_two(out + columns * 3, boxes.bottom.here + off.bottom);
}
