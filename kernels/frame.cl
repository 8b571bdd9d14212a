// SPDX-License-Identifier: MIT
// Stage frame up to the network, reference stss_ref/frame.py::prepare: every image-space stage of a frame, fused.
//
//  buffer     dir     shape             unit
//  motion0..4 in      (H, W, 2)         px, newest first; as many as the largest step are read
//  color0..2  in      (H, W, 3)         the three colour frames, newest first
//  gbuffer    in      (H, W, 9)         normal 3, depth, roughness, metallic, base colour 3
//  nov        in      (H, W)
//  stencil, stencil0..2 in (H, W)       of the frame itself, and of the colour frames
//  normal, normal0..2   in (H, W, 3)    likewise; from pixel to pixel normal_stride floats: 3, or 9 within a G-buffer
//  position, position0..2 in (H, W, 3)  likewise, cm
//  chained    in/out  (3, H, W, 2)      px, current -> each colour frame; not written where its step is 0, or was given as 0: nobody reads it
//  keys,first in/out  (H, W)            the splat's, occlusion_warp.cl; only places that a hole looks up are wanted
//  history    in/out  (3, R+2, C+2, 4)  oldest, middle, newest; warped rgb >= 0, mask; written if `stores`
//  x0         out     (R+2, C+2, 24)    occlusion_warp, second colour (both >= 0), the six * mask, gbuffer, 0 0 0
//  color3     out     (R, C, 4)         rgb of occlusion_warp, 0
//  mask       out     (H, W)            1 = newest frame to be trusted
//
// R, C = rows, columns = H, W rounded up to multiples of 8, filled by repeating the last row and column. Pixel (y, x) of history
// and x0 is at (y + 1, x + 1); their border of zeros is never written.
// history, x0 and color3 may be a strip of the frame: R rows whose row 0 is the frame's row `top`; mask and keys are of the whole.
// Build: -D of motion_chain.cl and holes.cl, optionally -D HALF (history and x0), and -D EARLIER where the second colour is the frame before's:
// then prepare runs for the older frames, and after that for the newest, since it reads what was stored of the one before.  Order: chain_steps, prepare, splat_nearest and splat_first (depth in gbuffer),
// fill_holes; then erm.cl's downsample_8.  Launch (W, H); prepare (C, frames, R), offset by the first frame; fill_holes (C, R); all rounded up.
#include "motion_chain.cl"
#include "prepare.clh"

// The map of the tiles to compute; elsewhere nothing has moved, and `chained` is 0 already.
#ifdef MARK
#define DIRTY_ARGUMENT , global const uchar *restrict dirty
#define IS_DIRTY(x, y) dirty[tile_of(x, y, (width + 7) / 8 * 8)]
#else
#define DIRTY_ARGUMENT
#define IS_DIRTY(x, y) true
#endif

// Of at most five frames, newest first; those that no step needs are not read.
#define MOTIONS                                                                                                                \
    global const float2 *restrict motion0, global const float2 *restrict motion1, global const float2 *restrict motion2,       \
        global const float2 *restrict motion3, global const float2 *restrict motion4

static inline void chain_pixel(global const float2 *const *motions, const int newest, const int middle, const int oldest,
                               global float2 *chained, const int height, const int width, const int x, const int y)
{
    const int pixel = y * width + x, plane = height * width;
    float2 motion = motions[0][pixel];
#pragma unroll
    for (int j = 1; j <= 5; ++j) {  // unrolled: the choice of the motion must not depend on a number in a register
        if (j > most(most(newest, middle), oldest)) break;
        if (j > 1) motion = chain_on(motion, motions[j - 1], x, y, height, width);
        if (j == newest) chained[pixel] = motion;
        if (j == middle) chained[plane + pixel] = motion;
        if (j == oldest) chained[2 * plane + pixel] = motion;
    }
}

kernel void chain_steps(MOTIONS, const int newest, const int middle, const int oldest, global float2 *restrict chained,
                        const int height, const int width DIRTY_ARGUMENT)
{
    const int x = get_global_id(0), y = get_global_id(1);
    global const float2 *motions[] = {motion0, motion1, motion2, motion3, motion4};
    if (x < width && y < height && IS_DIRTY(x, y))
        chain_pixel(motions, newest, middle, oldest, chained, height, width, x, y);
}

kernel void prepare(PREPARE_ARGUMENTS)
{
    const int x = get_global_id(0), i = get_global_id(1), y = get_global_id(2);
    if (x >= columns || y >= rows) return;
    const Frame f = FRAME(i);  // a step equal to the one before it stands for a missing frame
#ifdef MARK
    if (is_quiet(f, x, y, 1)) return;
#endif
    if (checks && x < width && top + y < height) note_all(f, nov, bad, (top + y) * width + x, 1);
    prepare_pixel(f, x, y);
}

#ifdef MARK
#define CHANGES_ARGUMENT , global uchar *restrict input_changes
#define CHANGES , input_changes
#else
#define CHANGES_ARGUMENT
#define CHANGES
#endif
#define FILL_ARGUMENTS                                                                                                         \
    global const float *restrict color, global const float2 *restrict motion, global uint *restrict keys,                      \
        global const uint *restrict first, global const uchar *restrict mask, global stored *restrict x0,                      \
        global float4 *restrict color3, const int height, const int width, const int rows, const int columns,                  \
        const int top CHANGES_ARGUMENT

// occlusion_warp where prepare left a hole; there colour * mask is 0 already. Nobody wants the place afterwards.
static inline void fill_pixel(FILL_ARGUMENTS, const int x, const int y)
{
    const int shown_x = x < width ? x : width - 1, shown_y = top + y < height ? top + y : height - 1, pixel = shown_y * width + shown_x;
    if (mask[pixel]) return;
    const Taps at = taps(follow(motion[pixel], shown_x, shown_y, height, width), height, width);
    const float3 c = not_negative(look_instead(color, splatted(motion, first, at.nw), shown_x, shown_y, height, width));
    keys[at.nw] = UNWANTED;
    const int padded = (y + 1) * (columns + 2) + x + 1;
#ifdef MARK
    float8 eight = LOAD8(x0, padded * 3);
    eight.s012 = c;
    const int changed = any_bit(replace8(eight, padded * 3, x0));
    if (replace_float4((float4)(c, 0.0f), color3 + y * columns + x) || changed) input_changes[tile_of(x, y, columns)] = 1;
#else
    global stored *to = x0 + padded * 24;
    STORE(c.x, 0, to);
    STORE(c.y, 1, to);
    STORE(c.z, 2, to);
    color3[y * columns + x] = (float4)(c, 0.0f);
#endif
}

kernel void fill_holes(FILL_ARGUMENTS)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x < columns && y < rows)
        fill_pixel(color, motion, keys, first, mask, x0, color3, height, width, rows, columns, top CHANGES, x, y);
}
