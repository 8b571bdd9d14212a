// SPDX-License-Identifier: MIT
// Stage frame up to the network, one work-item a row of eight pixels: the kernels of frame.cl for processors, with the same
// arguments and the same results. Positions, stencils and limits are computed in vectors where all taps lie in the frame;
// elsewhere, and where fewer than eight pixels are left, pixel by pixel as there.
// Build as frame.cl; chain_steps8 is for GATHER=gather_longest.  Launch as there, an eighth of the columns.
#define NOTE static __attribute__((noinline))
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
                         const int height, const int width DIRTY_ARGUMENT)
{
    const int x = get_global_id(0) * 8, y = get_global_id(1);
    if (x >= width || y >= height || !(IS_DIRTY(x, y) || IS_DIRTY(x + 4, y))) return;
    global const float2 *motions[] = {motion0, motion1, motion2, motion3, motion4};
    const int pixel = y * width + x, plane = height * width;
    if (x + 8 > width) {
        for (int i = 0; x + i < width; ++i)
            chain_pixel(motions, newest, middle, oldest, chained, height, width, x + i, y);
        return;
    }
    const float8 left = read8((global const float *)(motion0 + pixel)), right = read8((global const float *)(motion0 + pixel + 4));
    float8 mx = (float8)(left.even, right.even), my = (float8)(left.odd, right.odd);
    for (int j = 1; j <= most(most(newest, middle), oldest); ++j) {
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

// Three components of eight pixels in a row, as they lie in memory.
typedef struct {
    float8 a, b, c;
} Triple8;

INLINE Triple8 read_triple8(global const float *image)
{
    const Triple8 t = {read8(image), read8(image + 8), read8(image + 16)};
    return t;
}

// The squared distances of eight points.
INLINE float8 squared8(const Triple8 p, const Triple8 q)
{
    const float8 a = (p.a - q.a) * (p.a - q.a), b = (p.b - q.b) * (p.b - q.b), c = (p.c - q.c) * (p.c - q.c);
    return (float8)(a.s036, b.s147, c.s25) + (float8)(a.s147, b.s25, c.s036) + (float8)(a.s25, b.s036, c.s147);
}

// Where surely no pixel of eight is a hole, by the test on positions; `nw`: the first one's upper left tap, the others follow it.
INLINE bool surely_near8(const Frame f, const int pixel, const int nw, const float8 s, const float8 stencil, const float8 bias)
{
    const float8 change = 3.0f * (s - stencil), surely = bias > 1.0f && bias < 1e18f ? bias * bias * 0.99999f : (float8)(-1.0f);
    global const float *upper = f.position_previous + nw * 3, *lower = upper + f.width * 3;
    const Triple8 here = read_triple8(f.position + pixel * 3);
    return all8(s == 0.0f && change <= MESH && change >= -(MESH) && squared8(read_triple8(upper), here) <= surely &&
                squared8(read_triple8(upper + 3), here) <= surely && squared8(read_triple8(lower), here) <= surely &&
                squared8(read_triple8(lower + 3), here) <= surely);
}

// bilinear3 of eight pixels in a row whose taps are in a row, too.
INLINE Triple8 bilinear_triple8(global const float *upper, global const float *lower, const float8 fx, const float8 fy)
{
    const Triple8 nw = read_triple8(upper), ne = read_triple8(upper + 3), sw = read_triple8(lower), se = read_triple8(lower + 3);
    const Triple8 between = {BILINEAR(nw.a, ne.a, sw.a, se.a, fx.s00011122, fy.s00011122),
                             BILINEAR(nw.b, ne.b, sw.b, se.b, fx.s23334445, fy.s23334445),
                             BILINEAR(nw.c, ne.c, sw.c, se.c, fx.s55666777, fy.s55666777)};
    return between;
}

INLINE int8 larger8(const int8 largest, global const float *values)
{
    const int8 size = as_int8(read8(values)) & 0x7fffffff;
    return size > largest ? size : largest;
}

// note_all for eight pixels.
INLINE void note_all8(const Frame f, global const float *nov, global int *bad, const int pixel)
{
    int8 largest = larger8((int8)(0), f.stencil_previous + pixel);
    for (int i = 0; i < 24; i += 8) {
        largest = larger8(largest, f.color + pixel * 3 + i);
        largest = larger8(largest, f.normal_previous + pixel * 3 + i);
    }
    if (f.i == 0) {
        largest = larger8(larger8(largest, nov + pixel), f.stencil + pixel);
        for (int i = 0; i < 24; i += 8) largest = larger8(largest, f.normal + pixel * 3 + i);
        for (int i = 0; i < 72; i += 8) largest = larger8(largest, f.gbuffer + pixel * 9 + i);
    }
    if (!all8(largest < 0x7f800000)) note_all(f, nov, bad, pixel, 8);
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
    const bool whole = x + 8 <= width && top + y < height;
    if (checks && whole) note_all8(f, nov, bad, pixel);
    if (checks && !whole && x < width && top + y < height) note_all(f, nov, bad, pixel, width - x);
    if (f.step > 0 && whole) {
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
            if (in_a_row8(nw) && surely_near8(f, pixel, nw.s0, s, stencil, bias)) {
                const Triple8 t = bilinear_triple8(f.color + nw.s0 * 3, f.color + (nw.s0 + width) * 3, fx, fy);
#define WRITE(I, X, Y, Z) write_pixel(f, x + I, y, pixel + I, (float3)(t.X, t.Y, t.Z), true, 0);
                WRITE(0, a.s0, a.s1, a.s2) WRITE(1, a.s3, a.s4, a.s5) WRITE(2, a.s6, a.s7, b.s0) WRITE(3, b.s1, b.s2, b.s3)
                WRITE(4, b.s4, b.s5, b.s6) WRITE(5, b.s7, c.s0, c.s1) WRITE(6, c.s2, c.s3, c.s4) WRITE(7, c.s5, c.s6, c.s7)
#undef WRITE
                return;
            }
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

kernel void fill_holes8(FILL_ARGUMENTS)
{
    const int x = get_global_id(0) * 8, y = get_global_id(1);
    if (x >= columns || y >= rows) return;
    if (x + 8 <= width && top + y < height) {
        global const uchar8_anywhere *eight = (global const uchar8_anywhere *)(mask + (top + y) * width + x);
        if (as_ulong(*eight) == 0x0101010101010101ul) return;
    }
    for (int i = x; i < x + 8; ++i)
        fill_pixel(color, motion, keys, first, mask, x0, color3, height, width, rows, columns, top CHANGES, i, y);
}
