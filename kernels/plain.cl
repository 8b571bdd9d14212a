// Building block plain: where the decoder has something to add. Where the newest frame is flat and free of holes, what the network adds to
// the upsampled frame is next to nothing (docs/decisions/0019-plain-tiles-are-upsampled-alone.md).
//
//  buffer  dir  shape                       content
//  color   in   (rows, columns, 4)          the frame that is upsampled, see decoder.clh; sizes are multiples of 8
//  input   in   padded, (24)                what the first layer reads, see stss_cl/buffers.py: the G-buffer among it
//  mask    in   (H, W)                      1 = not a hole; H > rows - 8, W > columns - 8
//  wanted  out  (rows / 4, columns / 4)     0 = plain: at no pixel of the tile of 4 x 4, or next to it, lies a hole, or do three pixels in a row or
//                                             column depart from a straight line by more than `flat` in the colour or SURFACE in the G-buffer; 1 = any other;
//                                           near the frame's edge all are
// Build optionally -D HALF.  Launch (columns / 4, rows / 4).
//
// coarser: the map for a decoder's layers at half the size, of which those of `fine` read.  Launch (columns, rows) of `out`.
//
// The last layer of a size is computed in the wanted tiles; it reads one pixel around them, of what the layer before makes of two pixels around
// them: both are in reach of one tile (-D WANTED of winograd.cl, conv.cl, resample.cl). Those two pixels are upsampled from three of half the size.
#include "common.clh"
#include "changes.clh"

typedef float16 float16_anywhere __attribute__((aligned(4)));

#define SURFACE 0.1f  // an edge that the colour does not show: of what moved into an extrapolated frame, or lies within a hole's colour
#define EDGE 2  // tiles: the zeros around the frame make features that look like an edge
#define REACH 1  // tiles around the two by two that a coarser one covers: two pixels, and one that lies between those upsampled from

#define AT(place) (*(global const float16_anywhere *)(place))

#define MAGNITUDE(value) as_float16(as_uint16(value) & 0x7fffffffu)  // a function's argument of this size depends on the processor

// Whether the surface has an edge in the tile (x, y) or next to it.
static inline int has_edge(global const stored *restrict input, const int in_columns, const int x, const int y)
{
    int4 bent = 0;
    const int row = in_columns * 3;  // in eights
    for (int i = 4 * y - 1; i < 4 * y + 5; ++i)
        for (int j = 4 * x - 1; j < 4 * x + 5; ++j)
            for (int c = 1; c < 3; ++c) {
                const int at = ((i + 1) * in_columns + j + 1) * 3 + c;
                const float8 two = 2.0f * LOAD8(input, at);
                const float8 across = LOAD8(input, at - 3) - two + LOAD8(input, at + 3);
                const float8 down = LOAD8(input, at - row) - two + LOAD8(input, at + row);
                const int8 over = (as_float8(as_uint8(across) & 0x7fffffffu) > SURFACE) | (as_float8(as_uint8(down) & 0x7fffffffu) > SURFACE);
                bent |= c == 1 ? over.hi : over.lo | over.hi;  // the G-buffer begins at channel 12
            }
    return (bent.x | bent.y | bent.z | bent.w) != 0;
}

kernel void detail(global const float *restrict color, global const stored *restrict input, global const uchar *restrict mask,
                   global uchar *restrict wanted, const int width, const int in_columns, const float flat)
{
    const int x = get_global_id(0), y = get_global_id(1), columns = get_global_size(0), rows = get_global_size(1);
    int found = x < EDGE || y < EDGE || x >= columns - EDGE || y >= rows - EDGE;
    if (!found) {
        // Twice four pixels to a row of six, their middle two in common; of a pixel's four values the last is 0.
        const int row = 4 * columns * 4;
        int16 bent = 0;
        for (int i = 4 * y - 1; i < 4 * y + 5; ++i) {
            global const float *at = color + i * row + (4 * x - 1) * 4;
            for (int side = 0; side < 2; ++side, at += 8) {
                const float16 two = 2.0f * AT(at);
                bent |= MAGNITUDE(AT(at - 4) - two + AT(at + 4)) > flat;
                bent |= MAGNITUDE(AT(at - row) - two + AT(at + row)) > flat;
            }
            for (int j = 4 * x - 1; j < 4 * x + 5; ++j) found |= !mask[i * width + j];
        }
        const int8 eight = bent.lo | bent.hi;
        const int4 four = eight.lo | eight.hi;
        found |= (four.x | four.y | four.z | four.w) != 0;
    }
    wanted[y * columns + x] = found || has_edge(input, in_columns, x, y);
}

kernel void coarser(global const uchar *restrict fine, global uchar *restrict out, const int rows, const int columns)
{
    const int x = get_global_id(0), y = get_global_id(1);
    out[y * get_global_size(0) + x] = marked_tiles(fine, columns, max(2 * y - REACH, 0), min(2 * y + 1 + REACH, rows - 1),
                                                   max(2 * x - REACH, 0), min(2 * x + 1 + REACH, columns - 1));
}
