// SPDX-License-Identifier: MIT
// Stage frame up to the network, reference stss_ref/frame.py::prepare: every image-space stage of a frame, fused.
//
//  buffer           dir     shape             unit
//  motion0..4       in      (H, W, 2)         px, newest first; as many as the largest step are read
//  motions          in      (3, H, W, 2)      px, current -> the colour frames, newest first: result of chain_steps, or
//                                             motion0 if that did not run; read if `is_warped`
//  color            in      (H, W, 3)         of a colour frame
//  gbuffer          in      (H, W, 9)         normal 3, depth, roughness, metallic, base colour 3
//  nov              in      (H, W)
//  stencil          in      (H, W)            of the frame itself; stencil_previous: of the colour frame
//  normal           in      (H, W, 3)         likewise; from pixel to pixel normal_stride floats: 3, or 9 within a
//                                             G-buffer
//  position         in      (H, W, 3)         likewise, cm
//  splat            in/out  (2, H, W)         keys and first of occlusion_warp.cl, only at places that a hole looks up
//  samples          in/out  (H, W, 4)         reshade.cl's: -D RESHADE
//  history          in/out  (3, R+2, C+2, 4)  oldest, middle, newest; warped rgb >= 0, mask; an `image` of it
//  x0               out     (R+2, C+2, 24)    the newest frame, its holes filled (>= 0), second colour, the six * mask,
//                                             gbuffer, 0 0 0
//  color3           out     (R, C, 4)         rgb of the same, 0
//  mask             out     (H, W)            1 = newest frame can be trusted
//  bad              out     (5)               set to 1 where an input is not finite, if `checks`
//  dirty, changes   in, out                   maps of the tiles to compute, and of the tiles of x0 and the history that
//                                             changed; null: all are computed, none marked
//
// R, C = rows, columns = H, W rounded up to multiples of 8, filled by repeating the last row and column. Pixel (y, x)
// of history and x0 is at (y + 1, x + 1); no kernel writes their border of zeros.
// history, x0 and color3 may be a strip of the frame: R rows whose row 0 is the frame's row `top`; mask and splat
// cover the whole frame.
// Build -D of holes.cl, optionally
//  -D STORED        the type of history and x0
//  -D STREAM        see common.clh
//  -D EIGHT_PIXELS  a work-item has eight pixels in a row, for processors
//  -D DETAIL        the second colour is that of detail.clh
//  -D RESHADE       stage reshade fills the holes
//
// Order: chain_steps, prepare_newest, prepare_older for each older frame where the history is read, splat_nearest and
// splat_first (with -D RESHADE find_samples and, for each strip, find_lights), fill_holes; then downsample_8.cl. A new
// plane: README.md, Change a kernel.
// Launch (W, H); prepare_* and fill_holes (C, R); find_lights (W, R + STRIP_MARGIN); with EIGHT_PIXELS an eighth of the
// columns.
#ifdef EIGHT_PIXELS
#define AT_ONCE 8
#define CALLED static __attribute__((noinline))
#else
#define AT_ONCE 1
#endif
#include "motion_chain.clh"
#include "prepare.clh"
#ifdef EIGHT_PIXELS
#include "frame8.clh"
#else
#define note_eight(f, pixel) note_pixels(f, pixel, 8)
#endif

kernel void chain_steps(global const float2 *restrict motion0, global const float2 *restrict motion1,
                        global const float2 *restrict motion2, global const float2 *restrict motion3,
                        global const float2 *restrict motion4, const int newest, const int middle, const int oldest,
                        global float2 *restrict motions, const int height, const int width,
                        global const uchar *restrict dirty)
{
    const int left = get_global_id(0) * AT_ONCE, y = get_global_id(1);
    if (left >= width || y >= height) return;
    // In other tiles nothing moves, and the motion is 0 already.
    if (MARKS(dirty) && !any_dirty(dirty, left, y, (width + 7) / 8 * 8, AT_ONCE)) return;
    // clang-format off
    const Chain c = {{motion0, motion1, motion2, motion3, motion4}, newest, middle, oldest,
                     motions, motions + height * width, motions + 2 * height * width, height, width};
    // clang-format on
#ifdef EIGHT_PIXELS
    if (left + 8 <= width) {
        chain_eight(c, left, y);
        return;
    }
#endif
    for (int x = left; x < least(left + AT_ONCE, width); ++x) chain_pixel(c, x, y);
}

// The pixels of a work-item.
INLINE void prepare_pixels(const Frame f)
{
    const Task s = f.task;
    const int x = get_global_id(0) * AT_ONCE, y = get_global_id(1);
    if (x >= s.columns || y >= s.rows) return;
    if (f.marks && is_quiet(f, x, y, AT_ONCE)) return;
    const int pixel = (s.top + y) * s.width + x, shown = s.top + y < s.height ? least(s.width - x, AT_ONCE) : 0;
    if (f.task.checks && shown == 8)
        note_eight(f, pixel);
    else if (f.task.checks && shown > 0)
        note_pixels(f, pixel, shown);
#ifdef EIGHT_PIXELS
    if (shown == 8 && f.task.is_warped && prepare_eight(f, x, y)) return;
#ifdef DETAIL
    if (shown == 8 && f.is_newest && !f.task.is_warped) {
        write_eight(f, x, y, pixel, read_triple8(f.color + pixel * 3));
        return;
    }
#endif
#endif
    for (int i = 0; i < AT_ONCE; ++i) prepare_pixel(f, x + i, y);
}

kernel void prepare_older(PLANES(ARGUMENT) WRITTEN(ARGUMENT) global uchar *restrict changes, const Task task)
{
    const Frame f = {
        .task = task, .is_stored = true, .marks = MARKS(dirty), .changes = changes, PLANES(VALUE) WRITTEN(VALUE)};
    prepare_pixels(f);
}

// `stores`: write the history's last image, too.
kernel void prepare_newest(PLANES(ARGUMENT) OLDER(ARGUMENT) WRITTEN(ARGUMENT) NEWEST(ARGUMENT)
                               global uchar *restrict changes,
                           const Task task)
{
    const Frame f = {.task = task,
                     .is_newest = true,
                     .is_stored = task.stores,
                     .marks = MARKS(dirty),
                     .changes = changes,
                     PLANES(VALUE) OLDER(VALUE) WRITTEN(VALUE) NEWEST(VALUE)};
    prepare_pixels(f);
}

kernel void splat_nearest(global const float2 *restrict motions, global const float *restrict gbuffer,
                          volatile global uint *restrict splat, const int height, const int width)
{
    const int left = get_global_id(0) * AT_ONCE, y = get_global_id(1);
    if (left >= width || y >= height) return;
#ifdef EIGHT_PIXELS
    if (!is_wanted8(motions, splat, left, y, height, width)) return;
#endif
    for (int x = left; x < least(left + AT_ONCE, width); ++x)
        splat_depth(motions[y * width + x], x, y, depth_of(gbuffer, y * width + x), splat, height, width);
}

kernel void splat_first(global const float2 *restrict motions, global const float *restrict gbuffer,
                        global uint *restrict splat, const int height, const int width)
{
    const int left = get_global_id(0) * AT_ONCE, y = get_global_id(1);
    if (left >= width || y >= height) return;
#ifdef EIGHT_PIXELS
    if (!is_wanted8(motions, splat, left, y, height, width)) return;
#endif
    for (int x = left; x < least(left + AT_ONCE, width); ++x)
        splat_index(motions[y * width + x], x, y, depth_of(gbuffer, y * width + x), splat, splat + height * width,
                    height, width);
}

// Finds the samples of the holes' own surfaces: -D RESHADE.
kernel void find_samples(PLANES(ARGUMENT) global const uchar *restrict mask, global float4 *restrict samples,
                         const Task task)
{
    const int left = get_global_id(0) * AT_ONCE, y = get_global_id(1), width = task.width, height = task.height;
    if (left >= width || y >= height) return;
#ifdef EIGHT_PIXELS
    if (left + 8 <= width && all_valid8(mask + y * width + left)) return;
#endif
    // clang-format off
    const Surfaces s = {height, width, task.normal_stride, 9, stencil_previous, stencil, normal_previous, normal,
                        position_previous, position, 0};
    // clang-format on
    for (int x = left; x < least(left + AT_ONCE, width); ++x)
        if (!mask[y * width + x]) samples[y * width + x] = own_samples(s, color, motions[y * width + x], x, y);
}

// A processor's core computes neighbouring lines, and holes lie together: of `rows`, a multiple of 8, every eighth, so
// that all cores have some.
INLINE int row_of(const int line, const int rows)
{
#ifdef EIGHT_PIXELS
    return line % (rows / 8) * 8 + line / (rows / 8);
#else
    return line;
#endif
}

#ifdef RESHADE
// Finds the light of the holes of a strip and of those around it that share theirs, after find_samples: -D RESHADE.
kernel void find_lights(global const float *restrict color, global const float2 *restrict motions,
                        global const float *restrict gbuffer, global const float *restrict stencil,
                        global const float *restrict normal, global float4 *restrict color3,
                        global uchar *restrict mask, global const float4 *restrict samples,
                        global float4 *restrict lights, const Task task)
{
    const int left = get_global_id(0) * AT_ONCE, line = get_global_id(1), rows = task.rows + STRIP_MARGIN;
    if (left >= task.width || line >= rows) return;
    const int y = task.top - STRIP_MARGIN / 2 + row_of(line, rows);
    if (y < 0 || y >= task.height) return;
#ifdef EIGHT_PIXELS
    if (left + 8 <= task.width && all_valid8(mask + y * task.width + left)) return;
#endif
    const Frame f = {.task = task,
                     .color = color,
                     .motions = motions,
                     .gbuffer = gbuffer,
                     .stencil = stencil,
                     .normal = normal,
                     .color3 = color3,
                     .mask = mask,
                     .samples = samples};
    for (int x = left; x < least(left + AT_ONCE, task.width); ++x) {
        const int pixel = y * task.width + x;
        if (!mask[pixel]) lights[pixel] = find_light(f, pixel, x, y);
    }
}
#endif

kernel void fill_holes(PLANES(ARGUMENT) OLDER(ARGUMENT) NEWEST(ARGUMENT) global uchar *restrict changes,
                       global const float4 *restrict lights, const Task task)
{
    const int left = get_global_id(0) * AT_ONCE, line = get_global_id(1);
    if (left >= task.columns || line >= task.rows) return;
    const int y = row_of(line, task.rows);
#ifdef EIGHT_PIXELS
    if (left + 8 <= task.width && task.top + y < task.height && all_valid8(mask + (task.top + y) * task.width + left))
        return;
#endif
    const Frame f = {.task = task,
                     .lights = lights,
                     .marks = MARKS(changes),
                     .changes = changes,
                     PLANES(VALUE) OLDER(VALUE) NEWEST(VALUE)};
    for (int x = left; x < left + AT_ONCE; ++x) fill_pixel(f, x, y);
}
