// SPDX-License-Identifier: MIT
// Stage holes, reference stss_ref/holes.py::holes.
//
//  buffer             dir  shape      unit
//  motion             in   (H, W, 2)  px, current -> earlier; non-finite is off screen
//  stencil_previous   in   (H, W)     object number of the earlier frame, 0 = static
//  stencil            in   (H, W)     object number
//  normal_previous    in   (H, W, 3)  world space
//  normal             in   (H, W, 3)  world space
//  position_previous  in   (H, W, 3)  cm; may be non-finite
//  position           in   (H, W, 3)  cm; may be non-finite
//  nov                in   (H, W)     dot of normal and view vector
//  depth              in   (H, W)     normalised to [0, 1]
//  valid              out  (H, W)     1 = can be trusted, 0 = hole
//
// Build -D PAPER=1 for the paper's test of static surfaces, 0 for the test by the footprint; -D FOOTPRINTS, FACING,
// GRAZING, DEPTH (cm), COSINE, STATIC_COSINE, MESH = the limits, float literals.  Launch (W, H) rounded up.
#if !defined(PAPER) || !defined(FOOTPRINTS) || !defined(FACING) || !defined(GRAZING) || !defined(DEPTH) || \
    !defined(COSINE) || !defined(STATIC_COSINE) || !defined(MESH)
#error "holes.cl needs -D PAPER, FOOTPRINTS, FACING, GRAZING, DEPTH, COSINE, STATIC_COSINE and MESH"
#endif
#include "surface.clh"

#if PAPER
// Whether a squared distance is larger than bias squared; NaN counts as larger.
static __attribute__((noinline)) bool is_beyond(const float4 squared, const float bias)
{
    const float4 d = sqrt(squared);
    return !(d.x <= bias && d.y <= bias && d.z <= bias && d.w <= bias);
}

// Whether any of the four places is farther than bias.
INLINE bool is_far(global const float *previous, const float3 position, const Taps at, const float bias)
{
    const float8 top = read_pair3(previous, at.nw, at.right), bottom = read_pair3(previous, at.nw + at.below, at.right);
    const float4 x = (float4)(top.s04, bottom.s04) - position.x;
    const float4 y = (float4)(top.s15, bottom.s15) - position.y;
    const float4 z = (float4)(top.s26, bottom.s26) - position.z;
    const float4 squared = x * x + y * y + z * z;
    // Most places are nearer by more than the rounding of a square; these need no root.
    const float surely = bias > 1.0f && bias < 1e18f ? bias * bias * 0.99999f : -1.0f;
    if (squared.x <= surely && squared.y <= surely && squared.z <= surely && squared.w <= surely) return false;
    return is_beyond(squared, bias);
}

// The largest trusted distance on a static surface; of one pixel or of several.
#define BIAS(nov, depth) \
    (FACING * ((nov) < 0.0f ? -(nov) : (nov)) + GRAZING * (1.0f - ((nov) < 0.0f ? -(nov) : (nov))) + DEPTH * (depth))
#else

// The square of the distance to the position read between four places; NaN if that is NaN.
INLINE float squared_offset(global const float *previous, const float3 position, const Taps at)
{
    const float8 top = read_pair3(previous, at.nw, at.right), bottom = read_pair3(previous, at.nw + at.below, at.right);
    const float3 offset = BILINEAR(top.s012 - position, top.s456 - position, bottom.s012 - position,
                                   bottom.s456 - position, at.fx, at.fy);
    return sum3(offset * offset);
}
#endif

// Takes float4, as every function that is not inlined: Intel 2026.2 passes and returns float3 wrongly.
static __attribute__((noinline)) bool is_turned(const float4 of, const float4 earlier, const float least_cosine)
{
    const float3 normal = of.xyz, n = earlier.xyz;
    const float length = sqrt(sum3(n * n));
    const bool surface = any(normal != 0.0f) || any(n != 0.0f);  // not by its length: the square may be flushed to 0
    return surface && sum3(normal * n) / (length + 1e-5f) < least_cosine;
}

// A normal read between four pixels.
INLINE float3 normal_between(global const float *normal, const Taps at, const int stride)
{
    const int south = at.nw + at.below;
    const float3 nw = triple_at(normal, at.nw, stride), ne = triple_at(normal, at.nw + at.right, stride);
    const float3 sw = triple_at(normal, south, stride), se = triple_at(normal, south + at.right, stride);
    return BILINEAR(nw, ne, sw, se, at.fx, at.fy);
}

// Whether the warped colour of pixel (x, y) is trusted, if it is on screen; s is the stencil read at its taps.
// Positions are read only where s is 0; only the paper's test reads NoV and depth.
INLINE bool same_surface(const Taps at, const int x, const int y, const int height, const int width, const float s,
                         const float stencil, const float nov, const float depth, global const float *normal_previous,
                         global const float *normal, const int normal_stride, global const float *position_previous,
                         global const float *position)
{
    const int pixel = y * width + x;
    const float change = 3.0f * (s - stencil);
    if (change > MESH || change < -(MESH)) return false;
#if PAPER
    if (s == 0.0f) return !is_far(position_previous, read3(position, pixel), at, BIAS(nov, depth));
#else
    if (s == 0.0f && !(squared_offset(position_previous, read3(position, pixel), at) <=
                       FOOTPRINTS * FOOTPRINTS * squared_footprint(position, x, y, height, width)))
        return false;
#endif
    return !is_turned((float4)(triple_at(normal, pixel, normal_stride), 0.0f),
                      (float4)(normal_between(normal_previous, at, normal_stride), 0.0f),
                      s == 0.0f ? STATIC_COSINE : COSINE);
}

kernel void holes(global const float2 *restrict motion, global const float *restrict stencil_previous,
                  global const float *restrict stencil, global const float *restrict normal_previous,
                  global const float *restrict normal, global const float *restrict position_previous,
                  global const float *restrict position, global const float *restrict nov,
                  global const float *restrict depth, global uchar *restrict valid, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    const Place place = follow(motion[pixel], x, y, height, width);
    const Taps at = taps(place, height, width);
    valid[pixel] = leads_inside(place, height, width) &&
                   same_surface(at, x, y, height, width, bilinear1(stencil_previous, at), stencil[pixel], nov[pixel],
                                depth[pixel], normal_previous, normal, 3, position_previous, position);
}
