// SPDX-License-Identifier: MIT
// Stage frame up to the network, reference stss_ref/frame.py::prepare: every image-space stage of a frame, fused.
//
//  buffer           dir     shape             unit
//  motion0..4       in      (H, W, 2)         px, newest first; as many as the largest step are read
//  motion           in      (H, W, 2)         px, current -> the colour frame: what chain_steps gave; read if `is_warped`
//  color            in      (H, W, 3)         of a colour frame
//  gbuffer          in      (H, W, 9)         normal 3, depth, roughness, metallic, base colour 3
//  nov              in      (H, W)
//  stencil          in      (H, W)            of the frame itself; stencil_previous: of the colour frame
//  normal           in      (H, W, 3)         likewise; from pixel to pixel normal_stride floats: 3, or 9 within a G-buffer
//  position         in      (H, W, 3)         likewise, cm
//  keys, first      in/out  (H, W)            the splat's, occlusion_warp.cl; only places that a hole looks up are wanted
//  samples          in/out  (H, W, 4)         reshade.cl's: -D RESHADE
//  history          in/out  (3, R+2, C+2, 4)  oldest, middle, newest; warped rgb >= 0, mask; an `image` of it
//  x0               out     (R+2, C+2, 24)    the newest frame, its holes filled (>= 0), second colour, the six * mask, gbuffer, 0 0 0
//  color3           out     (R, C, 4)         rgb of the same, 0
//  mask             out     (H, W)            1 = newest frame to be trusted
//  bad              out     (5)               set to 1 where an input is not finite, if `checks`: prepare.clh
//  dirty, *_changes in, out                   maps of the tiles to compute, and of those that then differ; null: all are computed, none marked
//
// R, C = rows, columns = H, W rounded up to multiples of 8, filled by repeating the last row and column. Pixel (y, x) of history
// and x0 is at (y + 1, x + 1); their border of zeros is never written.
// history, x0 and color3 may be a strip of the frame: R rows whose row 0 is the frame's row `top`; mask and keys are of the whole.
// Build: -D of motion_chain.clh and holes.cl, optionally -D STORED (history and x0), -D STREAM, and -D EIGHTS: eight pixels in a row to a
// work-item, for processors; -D LONGEST where GATHER is gather_longest; -D DETAIL: the second colour is what warped frames show within a pixel;
// -D RESHADE: stage reshade fills the holes.
// Order: chain_steps, prepare_older for each older frame where the history is read, prepare_newest, splat_nearest, splat_first (with -D RESHADE find_samples), fill_holes; then downsample_8.cl.
// Launch (W, H); prepare_* and fill_holes (C, R); with EIGHTS an eighth of the columns.
#ifdef EIGHTS
#define AT_ONCE 8
#define CALLED static __attribute__((noinline))
#else
#define AT_ONCE 1
#endif
#include "motion_chain.clh"
#include "prepare.clh"
#ifdef EIGHTS
#include "frame8.clh"
#endif

kernel void chain_steps(global const float2 *restrict motion0, global const float2 *restrict motion1, global const float2 *restrict motion2,
                        global const float2 *restrict motion3, global const float2 *restrict motion4, const int newest, const int middle,
                        const int oldest, global float2 *restrict to_newest, global float2 *restrict to_middle, global float2 *restrict to_oldest,
                        const int height, const int width, global const uchar *restrict dirty)
{
    const int left = get_global_id(0) * AT_ONCE, y = get_global_id(1);
    if (left >= width || y >= height) return;
    // Elsewhere nothing has moved, and the motion is 0 already.
    if (MARKS(dirty) && !any_dirty(dirty, left, y, (width + 7) / 8 * 8, AT_ONCE)) return;
    const Chain c = {{motion0, motion1, motion2, motion3, motion4}, newest, middle, oldest, to_newest, to_middle, to_oldest, height, width};
#if defined(EIGHTS) && defined(LONGEST)
    if (left + 8 <= width) {
        chain_eight(c, left, y);
        return;
    }
#endif
    for (int x = left; x < least(left + AT_ONCE, width); ++x) chain_pixel(c, x, y);
}

// The pixels of a work-item.
INLINE void prepare_pixels(const Frame f, global int *bad, const int checks)
{
    const Strip s = f.strip;
    const int x = get_global_id(0) * AT_ONCE, y = get_global_id(1);
    if (x >= s.columns || y >= s.rows) return;
    if (f.marks && is_quiet(f, x, y, AT_ONCE)) return;
    const int pixel = (s.top + y) * s.width + x, shown = s.top + y < s.height ? least(s.width - x, AT_ONCE) : 0;
#ifdef EIGHTS
    if (checks && shown == 8)
        note_eight(f, bad, pixel);
    else
#endif
    if (checks && shown > 0) note_pixels(f, bad, pixel, shown);
#ifdef EIGHTS
    if (shown == 8 && f.is_warped && prepare_eight(f, x, y)) return;
#ifdef DETAIL
    if (shown == 8 && f.is_newest && !f.is_warped) {
        write_eight(f, x, y, pixel, read_triple8(f.color + pixel * 3));
        return;
    }
#endif
#endif
    for (int i = 0; i < AT_ONCE; ++i) prepare_pixel(f, x + i, y);
}

// The planes of every colour frame, and how they begin a Frame.
#define PLANES                                                                                                                          \
    global const float *restrict color, global const float2 *restrict motion, global const float *restrict gbuffer,                     \
        global const float *restrict nov, global const float *restrict stencil, global const float *restrict normal,                    \
        global const float *restrict position, global const float *restrict stencil_previous,                                           \
        global const float *restrict normal_previous, global const float *restrict position_previous, const int normal_stride
#define OF_PLANES                                                                                                                       \
    .color = color, .motion = motion, .gbuffer = gbuffer, .nov = nov, .stencil = stencil, .normal = normal, .position = position,       \
    .stencil_previous = stencil_previous, .normal_previous = normal_previous, .position_previous = position_previous,                   \
    .normal_stride = normal_stride

kernel void prepare_older(PLANES, global stored *restrict history, global uchar *restrict history_changes, global int *restrict bad,
                          const int is_warped, const int checks, const Strip strip, global const uchar *restrict dirty, const int image,
                          const int is_missing)
{
    const Frame f = {OF_PLANES, .is_warped = is_warped, .is_missing = is_missing, .is_stored = true, .strip = strip,
                     .history = history, .image = image, .marks = MARKS(dirty), .dirty = dirty,
                     .history_changes = history_map(history_changes, strip, image)};
    prepare_pixels(f, bad, checks);
}

// Of the older frames what -D DETAIL reads; reads_*: whether they are warped, and not missing.
#define OLDER                                                                                                                    \
    global const float *restrict middle_color, global const float *restrict oldest_color, global const float *restrict stencil_middle,      \
        global const float *restrict stencil_oldest, global const float2 *restrict to_middle, global const float2 *restrict to_oldest,      \
        const int reads_middle, const int reads_oldest
#define OF_OLDER                                                                                                                 \
    .middle = middle_color, .oldest = oldest_color, .stencil_middle = stencil_middle, .stencil_oldest = stencil_oldest,                     \
    .to_middle = reads_middle ? to_middle : 0, .to_oldest = reads_oldest ? to_oldest : 0

// `stores`: the history's last image is written.
kernel void prepare_newest(PLANES, global stored *restrict history, global uchar *restrict history_changes, global int *restrict bad,
                           const int is_warped, const int checks, const Strip strip, global const uchar *restrict dirty,
                           global stored *restrict x0, global float4 *restrict color3, global uchar *restrict mask,
                           global uint *restrict keys, global uint *restrict first, global uchar *restrict input_changes,
                           const int stores, const int marks_wanted, OLDER)
{
    const Frame f = {OF_PLANES, .is_newest = true, .is_warped = is_warped, .is_stored = stores, .strip = strip,
                     .history = history, .image = 2, OF_OLDER,
                     .x0 = x0, .color3 = color3, .mask = mask, .keys = keys, .first = first, .marks_wanted = marks_wanted,
                     .marks = MARKS(dirty), .dirty = dirty, .input_changes = input_changes, .history_changes = history_map(history_changes, strip, 2)};
    prepare_pixels(f, bad, checks);
}

kernel void splat_nearest(global const float2 *restrict motion, global const float *restrict gbuffer, volatile global uint *restrict keys,
                          const int height, const int width)
{
    const int left = get_global_id(0) * AT_ONCE, y = get_global_id(1);
    if (left >= width || y >= height) return;
#ifdef EIGHTS
    if (!is_wanted8(motion, keys, left, y, height, width)) return;
#endif
    for (int x = left; x < least(left + AT_ONCE, width); ++x)
        splat_depth(motion[y * width + x], x, y, depth_of(gbuffer, y * width + x), keys, height, width);
}

kernel void splat_first(global const float2 *restrict motion, global const float *restrict gbuffer, global const uint *restrict keys,
                        volatile global uint *restrict first, const int height, const int width)
{
    const int left = get_global_id(0) * AT_ONCE, y = get_global_id(1);
    if (left >= width || y >= height) return;
#ifdef EIGHTS
    if (!is_wanted8(motion, keys, left, y, height, width)) return;
#endif
    for (int x = left; x < least(left + AT_ONCE, width); ++x)
        splat_index(motion[y * width + x], x, y, depth_of(gbuffer, y * width + x), keys, first, height, width);
}

// The samples of their own that the frame's holes have: -D RESHADE.
kernel void find_samples(global const float *restrict color, global const float2 *restrict motion, global const uchar *restrict mask,
                         global const float *restrict stencil, global const float *restrict normal, global const float *restrict position,
                         global const float *restrict stencil_previous, global const float *restrict normal_previous,
                         global const float *restrict position_previous, const int normal_stride, global float4 *restrict samples,
                         const int height, const int width)
{
    const int left = get_global_id(0) * AT_ONCE, y = get_global_id(1);
    if (left >= width || y >= height) return;
#ifdef EIGHTS
    if (left + 8 <= width && all_valid8(mask + y * width + left)) return;
#endif
    const Surfaces s = {height, width, normal_stride, 9, stencil_previous, stencil, normal_previous, normal, position_previous, position, 0};
    for (int x = left; x < least(left + AT_ONCE, width); ++x)
        if (!mask[y * width + x]) samples[y * width + x] = own_samples(s, color, motion[y * width + x], x, y);
}

kernel void fill_holes(global const float *restrict color, global const float2 *restrict motion, global uint *restrict keys,
                       global uint *restrict first, global uchar *restrict mask, global stored *restrict x0,
                       global float4 *restrict color3, global uchar *restrict input_changes, const Strip strip,
                       global const float *restrict stencil, global const float *restrict stencil_previous,
                       global const float *restrict gbuffer, global const float *restrict normal, const int normal_stride,
                       global const float4 *restrict samples, OLDER)
{
    const int left = get_global_id(0) * AT_ONCE, y = get_global_id(1);
    if (left >= strip.columns || y >= strip.rows) return;
#ifdef EIGHTS
    if (left + 8 <= strip.width && strip.top + y < strip.height && all_valid8(mask + (strip.top + y) * strip.width + left)) return;
#endif
    const Frame f = {OF_OLDER, .stencil = stencil, .stencil_previous = stencil_previous, .is_warped = true, .color = color, .motion = motion, .gbuffer = gbuffer, .normal = normal,
                     .normal_stride = normal_stride, .samples = samples, .keys = keys, .first = first, .mask = mask, .x0 = x0, .color3 = color3,
                     .marks = MARKS(input_changes), .input_changes = input_changes, .strip = strip};
    for (int x = left; x < left + AT_ONCE; ++x) fill_pixel(f, x, y);
}
