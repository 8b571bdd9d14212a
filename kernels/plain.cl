// Building block plain: where the decoder has something to add. Where the newest frame is flat and free of holes, what the network adds to
// the upsampled frame is next to nothing (docs/decisions/0019-plain-tiles-are-upsampled-alone.md).
//
//  buffer  dir  shape                       content
//  color   in   (rows, columns, 4)          the frame that is upsampled, see decoder.clh; sizes are multiples of 8
//  mask    in   (H, W)                      1 = not a hole; H > rows - 8, W > columns - 8
//  wanted  out  (rows / 4, columns / 4)     0 = plain: at no pixel of the tile of 4 x 4, or next to it, lies a hole, or do three pixels in a row or
//                                             column depart from a straight line by more than `flat`; 1 = any other; near the frame's edge all are
// Launch (columns / 4, rows / 4).
//
// coarser: the map for a decoder's layers at half the size, of which those of `fine` read.  Launch (columns, rows) of `out`.
//
// The last layer of a size is computed in the wanted tiles; it reads one pixel around them, of what the layer before makes of two pixels around
// them: both are in reach of one tile (-D WANTED of winograd.cl, conv.cl, resample.cl). Those two pixels are upsampled from three of half the size.
#include "common.clh"
#include "changes.clh"

typedef float16 float16_anywhere __attribute__((aligned(4)));

#define EDGE 2  // tiles: the zeros around the frame make features that look like an edge
#define REACH 1  // tiles around the two by two that a coarser one covers: two pixels, and one that lies between those upsampled from

#define AT(place) (*(global const float16_anywhere *)(place))

static inline float16 magnitude(const float16 value) { return as_float16(as_uint16(value) & 0x7fffffffu); }

kernel void detail(global const float *restrict color, global const uchar *restrict mask, global uchar *restrict wanted, const int width,
                   const float flat)
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
                bent |= magnitude(AT(at - 4) - two + AT(at + 4)) > flat;
                bent |= magnitude(AT(at - row) - two + AT(at + row)) > flat;
            }
            for (int j = 4 * x - 1; j < 4 * x + 5; ++j) found |= !mask[i * width + j];
        }
        const int8 eight = bent.lo | bent.hi;
        const int4 four = eight.lo | eight.hi;
        found |= (four.x | four.y | four.z | four.w) != 0;
    }
    wanted[y * columns + x] = found;
}

kernel void coarser(global const uchar *restrict fine, global uchar *restrict out, const int rows, const int columns)
{
    const int x = get_global_id(0), y = get_global_id(1);
    out[y * get_global_size(0) + x] = marked_tiles(fine, columns, max(2 * y - REACH, 0), min(2 * y + 1 + REACH, rows - 1),
                                                   max(2 * x - REACH, 0), min(2 * x + 1 + REACH, columns - 1));
}
