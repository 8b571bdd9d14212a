// SPDX-License-Identifier: MIT
// Stage frame up to the network, one work-item a row of eight pixels: the kernels of frame.cl for processors, with the same
// arguments and the same results. Positions, stencils and limits are computed in vectors where all taps lie in the frame;
// elsewhere, and where fewer than eight pixels are left, pixel by pixel as there.
// Build as frame.cl; chain_steps8 is for GATHER=gather_longest.  Launch as there, an eighth of the columns.
#include "frame.cl"
#include "lanes.clh"

// gather_longest of eight pixels in a row, all of whose four pixels lie in the frame; x, y apart.
INLINE Pair8 gather_longest8(global const float2 *motion, const int8 corner, const int width)
{
    float8 nwx, nwy, nex, ney, swx, swy, sex, sey;
    if (in_a_row8(corner)) {
#define READ(NAME, PIXEL) const Pair8 NAME = read_motions8(motion + corner.s0 + PIXEL); NAME##x = NAME.a, NAME##y = NAME.b;
        READ(nw, 0) READ(ne, 1) READ(sw, width) READ(se, width + 1)
#undef READ
    } else {
#define READ(I) const float4 t##I = read4(motion + corner.s##I), b##I = read4(motion + corner.s##I + width);
        LANES(READ)
#undef READ
        nwx = GATHERED(t, x), nwy = GATHERED(t, y), nex = GATHERED(t, z), ney = GATHERED(t, w);
        swx = GATHERED(b, x), swy = GATHERED(b, y), sex = GATHERED(b, z), sey = GATHERED(b, w);
    }
#define SQUARE(NAME) \
    const float8 NAME##_square = NAME##x * NAME##x + NAME##y * NAME##y, NAME = NAME##_square < INFINITY ? NAME##_square : (float8)(INFINITY);
    SQUARE(nw) SQUARE(ne) SQUARE(sw) SQUARE(se)
#undef SQUARE
    // Not "still ? 0 : x": Oclgrind 21.10 negates vectors of conditions wrongly.
    const int8 moves =
        (nwx != 0.0f || nwy != 0.0f) && (nex != 0.0f || ney != 0.0f) && (swx != 0.0f || swy != 0.0f) && (sex != 0.0f || sey != 0.0f);
    const int8 upper = ne > nw, lower = se > sw, below = (lower ? se : sw) > (upper ? ne : nw);
    const float8 x = below ? (lower ? sex : swx) : (upper ? nex : nwx), y = below ? (lower ? sey : swy) : (upper ? ney : nwy);
    const Pair8 longest = {moves ? x : (float8)(0.0f), moves ? y : (float8)(0.0f)};
    return longest;
}

// chain_steps for gather_longest, one work-item a row of eight pixels.
kernel void chain_steps8(MOTIONS, const int newest, const int middle, const int oldest, global float2 *restrict chained,
                         global uint *restrict keys, global uint *restrict first, const int height, const int width
                         DIRTY_ARGUMENT)
{
    const int x = get_global_id(0) * 8, y = get_global_id(1);
    if (x >= width || y >= height || !(IS_DIRTY(x, y) || IS_DIRTY(x + 4, y))) return;
    global const float2 *motions[] = {motion0, motion1, motion2, motion3, motion4};
    const int pixel = y * width + x, plane = height * width;
    if (x + 8 > width) {
        for (int i = 0; x + i < width; ++i)
            chain_pixel(motions, newest, middle, oldest, chained, keys, first, height, width, x + i, y);
        return;
    }
    *(global uint8_anywhere *)(keys + pixel) = (uint8)(UNWANTED);
    *(global uint8_anywhere *)(first + pixel) = (uint8)(NOBODY);
    const float8 left = read8((global const float *)(motion0 + pixel)), right = read8((global const float *)(motion0 + pixel + 4));
    float8 mx = (float8)(left.even, right.even), my = (float8)(left.odd, right.odd);
    for (int j = 1; j <= most(newest, oldest); ++j) {
        if (j > 1) {
            global const float2 *restrict earlier = motions[j - 1];
            const Place8 at = follow8(mx, my, x, y);
            if (all_inside8(at, height, width)) {
                const Pair8 more = gather_longest8(earlier, raster8(at, width), width);
                mx += more.a;
                my += more.b;
            } else {
#define CHAIN(I) const float2 m##I = chain_on((float2)(mx.s##I, my.s##I), earlier, x + I, y, height, width);
                LANES(CHAIN)
#undef CHAIN
                mx = GATHERED(m, x);
                my = GATHERED(m, y);
            }
        }
        const float16 both = (float16)(mx, my).s08192a3b4c5d6e7f;
        if (j == newest) *(global float16_anywhere *)(chained + pixel) = both;
        if (j == middle) *(global float16_anywhere *)(chained + plane + pixel) = both;
        if (j == oldest) *(global float16_anywhere *)(chained + 2 * plane + pixel) = both;
    }
}

// A stencil and its right neighbour, of eight places: the left ones, then the right ones.
INLINE Pair8 read_pairs8(global const float *image, const int8 at)
{
    if (in_a_row8(at)) {
        const Pair8 rows = {read8(image + at.s0), read8(image + at.s0 + 1)};
        return rows;
    }
#define READ(I) const float2 p##I = *(global const float2_anywhere *)(image + at.s##I);
    LANES(READ)
#undef READ
    const Pair8 pairs = {GATHERED(p, x), GATHERED(p, y)};
    return pairs;
}

kernel void prepare8(PREPARE_ARGUMENTS)
{
    const int x = get_global_id(0) * 8, i = get_global_id(1), y = get_global_id(2);
    if (x >= columns || y >= rows) return;
    const Frame f = FRAME(i);
#ifdef MARK
    if (is_quiet(f, x, y, 8)) return;
#endif
    const int pixel = (top + y) * width + x;
    if (f.step > 0 && x + 8 <= width && top + y < height) {
        const float16 motion = *(global const float16_anywhere *)(f.chained + pixel);
        const Place8 place = follow8(motion.even, motion.odd, x, top + y);
        if (all_inside8(place, height, width)) {
            const int8 nw = raster8(place, width);
            const float8 fx = place.fx, fy = place.fy;
            const Pair8 upper = read_pairs8(f.stencil_previous, nw), lower = read_pairs8(f.stencil_previous, nw + width);
            const float8 s = BILINEAR(upper.a, upper.b, lower.a, lower.b, fx, fy), stencil = read8(f.stencil + pixel);
            global const float *g = f.gbuffer + pixel * 9 + 3;
            const float8 depth = (float8)(g[0], g[9], g[18], g[27], g[36], g[45], g[54], g[63]), v = read8(nov + pixel);
            const float8 bias = BIAS(v, depth);
#define WRITE(I)                                                                                                               \
    {                                                                                                                          \
        const Taps at = {nw.s##I, 1, width, fx.s##I, fy.s##I};                                                                 \
        const bool valid = same_surface(at, pixel + I, s.s##I, stencil.s##I, bias.s##I, f.normal_previous, f.normal,           \
                                        f.normal_stride, f.position_previous, f.position);                                    \
        write_pixel(f, x + I, y, pixel + I, bilinear3(f.color, at), valid, at.nw);                                             \
    }
            LANES(WRITE)
#undef WRITE
            return;
        }
    }
    for (int lane = 0; lane < 8; ++lane) prepare_pixel(f, x + lane, y);
}

// Whether any pixel may look up a place that one of these eight pixels lands on; false only where surely none does. Others may lower the
// keys meanwhile: none of them is UNWANTED before or after.
INLINE bool is_wanted8(global const float2 *motion, volatile global const uint *keys, const int x, const int y,
                       const int height, const int width)
{
    if (x + 8 > width) return true;
    const float16 m = *(global const float16_anywhere *)(motion + y * width + x);
    const Place8 to = follow8(m.even, m.odd, x, y);
    if (!all_inside8(to, height, width)) return true;
    const int8 at = raster8(to, width);
    if (in_a_row8(at)) {
        volatile global const uint8_anywhere *upper = (volatile global const uint8_anywhere *)(keys + at.s0);
        volatile global const uint8_anywhere *lower = (volatile global const uint8_anywhere *)(keys + at.s0 + width);
        const uint8 both = *upper | *lower;
        const uint4 four = both.lo | both.hi;
        return ((four.x | four.y | four.z | four.w) | keys[at.s7 + 1] | keys[at.s7 + 1 + width]) != UNWANTED;
    }
    uint wanted = 0;
#define READ(I) wanted |= keys[at.s##I] | keys[at.s##I + 1] | keys[at.s##I + width] | keys[at.s##I + width + 1];
    LANES(READ)
#undef READ
    return wanted != UNWANTED;
}

kernel void splat_nearest8(global const float2 *restrict motion, global const float *restrict depth, const int depth_stride,
                           const int depth_offset, volatile global uint *restrict keys, const int height, const int width)
{
    const int x = get_global_id(0) * 8, y = get_global_id(1);
    if (x >= width || y >= height || !is_wanted8(motion, keys, x, y, height, width)) return;
    for (int pixel = y * width + x, i = x; i < x + 8 && i < width; ++i, ++pixel)
        splat_depth(motion[pixel], i, y, depth + pixel * depth_stride + depth_offset, keys, height, width);
}

kernel void splat_first8(global const float2 *restrict motion, global const float *restrict depth, const int depth_stride,
                         const int depth_offset, global const uint *restrict keys, volatile global uint *restrict first,
                         const int height, const int width)
{
    const int x = get_global_id(0) * 8, y = get_global_id(1);
    if (x >= width || y >= height || !is_wanted8(motion, keys, x, y, height, width)) return;
    for (int pixel = y * width + x, i = x; i < x + 8 && i < width; ++i, ++pixel)
        splat_index(motion[pixel], i, y, depth + pixel * depth_stride + depth_offset, keys, first, height, width);
}
