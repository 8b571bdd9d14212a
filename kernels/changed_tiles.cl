// SPDX-License-Identifier: MIT
// arrive.cl for processors, with the same buffers: a work-item has SPAN tiles of a row of tiles. It reads one array
// after the other, since a processor prefetches only few streams at a time, and TOGETHER tiles at once, since most do
// not change.
//
// Build -D SPAN=tiles of a work-item, optionally -D PREFETCH (of values AHEAD).  Launch (ceil(ceil(W / 4) / SPAN),
// ceil(H / 4)).
#ifndef SPAN
#error "changed_tiles.cl needs -D SPAN=tiles of a work-item"
#endif
#include "common.clh"
#include "arrive.clh"

#define TOGETHER 16
#define AHEAD 512
#define EXPONENT 0x7f800000u
typedef uint16 uint16_anywhere __attribute__((aligned(4)));
// Always inline: on PoCL a called function has no vectors of 16.
#define ALWAYS static inline __attribute__((always_inline))

// The bits in which values differ from the previous ones, if they are compared, and the largest value without its sign.
typedef struct {
    uint16 differ, largest;
} Seen;

ALWAYS Seen see(global const uint *now, global const uint *before, const int count, const int compares)
{
    Seen s = {0, 0};
    int i = 0;
    for (; i + 16 <= count; i += 16) {
#ifdef PREFETCH
        __builtin_prefetch((const void *)(size_t)(now + i + AHEAD), 0, 2);
        if (compares) __builtin_prefetch((const void *)(size_t)(before + i + AHEAD), 0, 2);
#endif
        const uint16 value = *(global const uint16_anywhere *)(now + i), size = value & 0x7fffffffu;
        if (compares) s.differ |= value ^ *(global const uint16_anywhere *)(before + i);
        s.largest = size > s.largest ? size : s.largest;
    }
    for (; i < count; ++i) {
        const uint size = now[i] & 0x7fffffffu;
        if (compares) s.differ.s0 |= now[i] ^ before[i];
        if (size > s.largest.s0) s.largest.s0 = size;
    }
    return s;
}

ALWAYS bool any16(const uint16 v)
{
    const uint8 eight = v.lo | v.hi;
    const uint4 four = eight.lo | eight.hi;
    const uint2 two = four.lo | four.hi;
    return (two.x | two.y) != 0;
}

// Reads the four rows from row y on, `floats` values a pixel, of the tiles first .. last. Marks the tiles with a value
// that differs from `before`, and with `moves` those with a value other than 0; -0 counts as 0. Returns whether a value
// is not finite.
ALWAYS bool look(global const uint *now, global const uint *before, const int floats, const int y, const int first,
                 const int last, const int height, const int width, const int compares, const bool moves, uchar *marks)
{
    uint16 infinite = 0;
    for (int row = y; row < least(y + 4, height); ++row)
        for (int t = first; t < last; t += TOGETHER) {
            const int end = least(t + TOGETHER, last), at = (row * width + 4 * t) * floats;
            const Seen all = see(now + at, before + at, (least(4 * end, width) - 4 * t) * floats, compares && !moves);
            infinite |= as_uint16(all.largest >= EXPONENT);
            if (!compares || !any16(moves ? all.largest : all.differ)) continue;
            for (int i = t; i < end; ++i) {
                const int place = (row * width + 4 * i) * floats;
                if (marks[i - first]) continue;
                const Seen one = see(now + place, before + place, least(4, width - 4 * i) * floats, !moves);
                marks[i - first] = any16(moves ? one.largest : one.differ);
            }
        }
    return any16(infinite);
}

kernel void arrive(global const uint *restrict motion, global const uint *restrict gbuffer,
                   global const uint *restrict nov, global const uint *restrict stencil,
                   global const uint *restrict position, global const uint *restrict color,
                   global const uint *gbuffer_before, global const uint *nov_before, global const uint *stencil_before,
                   global const uint *position_before, global const uint *color_before, global int *restrict bad,
                   global uchar *restrict differs, const Arrival arrival)
{
    const int height = arrival.height, width = arrival.width;
    const int columns = (width + 3) / 4, first = get_global_id(0) * SPAN, last = least(first + SPAN, columns),
              y = 4 * get_global_id(1);
    uchar marks[SPAN], colored[SPAN];
    for (int t = 0; t < last - first; ++t) marks[t] = colored[t] = 0;
    if (arrival.compares) look(motion, motion, 2, y, first, last, height, width, true, true, marks);
    if (look(gbuffer, gbuffer_before, 9, y, first, last, height, width, arrival.compares, false, marks)) bad[1] = 1;
    if (arrival.compares) look(position, position_before, 3, y, first, last, height, width, true, false, marks);
    if (look(nov, nov_before, 1, y, first, last, height, width, arrival.compares, false, marks)) bad[2] = 1;
    if (look(stencil, stencil_before, 1, y, first, last, height, width, arrival.compares, false, marks)) bad[3] = 1;
    if (arrival.has_color &&
        look(color, color_before, 3, y, first, last, height, width, arrival.recolors, false, colored))
        bad[0] = 1;
    global uchar *to = differs + get_global_id(1) * columns;
    for (int t = first; arrival.compares && t < last; ++t)
        to[t] = marks[t - first] * CHANGED | colored[t - first] * RECOLORED;
}
