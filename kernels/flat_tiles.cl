// Building block plain: the tiles where the decoder has something to add. Where the newest frame is flat and free of holes, the network adds
// almost nothing to the upsampled frame (docs/decisions/0019-plain-tiles-are-upsampled-alone.md).
//
//  buffer  dir  shape                       content
//  color   in   (rows, columns, 4)          the frame that is upsampled, see decoder.clh; sizes are multiples of 8
//  gbuffer in   (H, W, 9)
//  mask    in   (H, W)                      1 = not a hole; H > rows - 8, W > columns - 8
//  marked  out  (rows / 4, columns / 4)     0 = plain: at no pixel of the tile of 4 x 4, or next to it, lies a hole, or do three pixels in a row or
//                                             column depart from a straight line by more than `flat` in the colour or SURFACE in the G-buffer; 1 = any other;
//                                           near the frame's edge all are
// Launch (columns / 4, rows / 4), or more.
//
// widened: `wanted`, the marked tiles and those next to them. In aliased frames a wire has gaps, and the network draws it there.
// Launch (columns / 4, rows / 4), or more.
//
// departure: the change that leaving out the flat tiles would make, measured on an image that the whole network made.
//  image    in   (2H, 2W, 3)
//  apart    out  (rows / 4, columns / 4)     the largest difference from the upsampled frame in a flat tile; 0 in the others
// Launch (columns / 4, rows / 4), or more.
//
// coarser: the map for a decoder's layers at half the size, of which those of `fine` read.  Launch the size of `out`, or more; `rows`, `columns` are those of `fine`.
//
// The last layer of a size is computed in the wanted tiles; it reads one pixel around them, of what the layer before makes of two pixels around
// them: both are in reach of one tile (stss_cl/skip/flat_tiles.py). Those two pixels are upsampled from three of half the size.
#include "common.clh"
#include "change_map.clh"
#include "decoder.clh"

typedef float8 float8_anywhere __attribute__((aligned(4)));
typedef float16 float16_anywhere __attribute__((aligned(4)));

#define SURFACE 0.1f  // an edge that the colour does not show: of what moved into an extrapolated frame, or lies within a hole's colour
#define EDGE 2  // tiles of the frame, and one more by `widened`: the zeros around the frame make features that look like an edge
#define REACH 1  // tiles around the two by two that a coarser one covers: two pixels, and one that lies between those upsampled from

#define TILES(length) (((length) + 7) / 8 * 2)  // of a side of the frame, padded to a multiple of 8

#define AT8(place) (*(global const float8_anywhere *)(place))
#define AT16(place) (*(global const float16_anywhere *)(place))

#define MAGNITUDE(value) as_float16(as_uint16(value) & 0x7fffffffu)  // a function's argument of this size depends on the processor

#define MAGNITUDE8(value) as_float8(as_uint8(value) & 0x7fffffffu)

static inline float8 six(global const float *at)
{
    return (float8)(*(global const float4_unaligned *)at, *(global const float2_unaligned *)(at + 4), 0.0f, 0.0f);
}

// Whether the surface has an edge in the tile (x, y) or next to it: 54 values a row, of which a neighbour's lie nine apart.
static inline int has_edge(global const float *restrict gbuffer, const int width, const int x, const int y)
{
    int8 bent = 0;
    const int row = 9 * width;
    for (int i = 4 * y - 1; i < 4 * y + 5; ++i)
        for (int k = 0; k < 54; k += 8) {
            global const float *at = gbuffer + i * row + (4 * x - 1) * 9 + min(k, 54 - 8);
            const float8 two = 2.0f * AT8(at);
            bent |= MAGNITUDE8(AT8(at - 9) - two + AT8(at + 9)) > SURFACE;
            bent |= MAGNITUDE8(AT8(at - row) - two + AT8(at + row)) > SURFACE;
        }
    const int4 four = bent.lo | bent.hi;
    return (four.x | four.y | four.z | four.w) != 0;
}

kernel void detail(global const float *restrict gbuffer, global const float *restrict color, global const uchar *restrict mask,
                   global uchar *restrict marked, const int height, const int width, const float flat)
{
    const int x = get_global_id(0), y = get_global_id(1), columns = TILES(width);
    if (x >= columns || y >= TILES(height)) return;
    int found = x < EDGE || y < EDGE || 4 * (x + EDGE) >= width || 4 * (y + EDGE) >= height;
    if (!found) {
        // Twice four pixels to a row of six, their middle two in common; of a pixel's four values the last is 0.
        const int row = 4 * columns * 4;
        int16 bent = 0;
        for (int i = 4 * y - 1; i < 4 * y + 5; ++i) {
            global const float *at = color + i * row + (4 * x - 1) * 4;
            for (int side = 0; side < 2; ++side, at += 8) {
                const float16 two = 2.0f * AT16(at);
                bent |= MAGNITUDE(AT16(at - 4) - two + AT16(at + 4)) > flat;
                bent |= MAGNITUDE(AT16(at - row) - two + AT16(at + row)) > flat;
            }
            for (int j = 4 * x - 1; j < 4 * x + 5; ++j) found |= !mask[i * width + j];
        }
        const int8 eight = bent.lo | bent.hi;
        const int4 four = eight.lo | eight.hi;
        found |= (four.x | four.y | four.z | four.w) != 0;
    }
    marked[y * columns + x] = found || has_edge(gbuffer, width, x, y);
}

kernel void widened(global const uchar *restrict found, global uchar *restrict wanted, const int rows, const int columns)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= columns || y >= rows) return;
    wanted[y * columns + x] = marked_tiles(found, columns, max(y - 1, 0), min(y + 1, rows - 1), max(x - 1, 0), min(x + 1, columns - 1));
}

kernel void coarser(global const uchar *restrict fine, global uchar *restrict out, const int rows, const int columns)
{
    const int x = get_global_id(0), y = get_global_id(1), out_columns = (columns + 1) / 2;
    if (x >= out_columns || y >= (rows + 1) / 2) return;
    out[y * out_columns + x] = marked_tiles(fine, columns, max(2 * y - REACH, 0), min(2 * y + 1 + REACH, rows - 1),
                                            max(2 * x - REACH, 0), min(2 * x + 1 + REACH, columns - 1));
}

kernel void departure(global const uchar *restrict wanted, global const float4 *restrict color, global const float *restrict image,
                      global float *restrict apart, const int height, const int width)
{
    const int x = 4 * get_global_id(0), y = 4 * get_global_id(1), columns = TILES(width), rows = TILES(height);
    if (x >= 4 * columns || y >= 4 * rows) return;
    const int tile = get_global_id(1) * columns + get_global_id(0);
    float8 most = 0.0f;
    for (int i = y; i < min(y + 4, height) && !wanted[tile]; ++i) {
        float4 upper[6], lower[6];
        between_rows(color, i, x, 4 * rows, 4 * columns, upper, lower);
        global const float *at = image + (2 * i * (2 * width) + 2 * x) * 3;
#pragma unroll
        for (int j = 0; j < 4; ++j, at += 6) {
            if (x + j >= width) continue;
            most = fmax(most, MAGNITUDE8(six(at) - between_columns(upper + j)));
            most = fmax(most, MAGNITUDE8(six(at + 6 * width) - between_columns(lower + j)));
        }
    }
    const float4 four = fmax(most.lo, most.hi);
    apart[tile] = fmax(fmax(four.x, four.y), fmax(four.z, four.w));
}
