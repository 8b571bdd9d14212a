// SPDX-License-Identifier: MIT
// From the network's image to the caller's, references stss_ref/resample.py::upsample_centres and stss/images/color.py.
//
//  buffer    dir  shape        unit
//  plane     in   (H, W, C)    any unit; finite
//  motion    in   (H, W, 2)    px, display frame -> rendered frame; non-finite reads the pixel itself
//  moved     out  (H, W, C)    as plane
//  enlarged  out  (2H, 2W, C)  as plane
//  image     in   (2H, 2W, 3)  display-referred
//  above     in   (2H, 2W, 3)  scene-linear, the part above 1, at least 0; not read if highlights is 0
//  color     out  (2H, 2W, 3)  scene-linear; display-referred if srgb is 0
//  bad       out  (1)          set to 1 where image is not finite
//
// Channels and curve are arguments, so that one program serves all.
// Launch (W, H) rounded up, a pixel each; decode (W, H / 2), any 24 numbers of the image each.
#include "sample.clh"
#include "lanes.clh"

// A float with all of these bits is not finite.
#define EXPONENT 0x7f800000

kernel void move(global const float *restrict plane, global const float2 *restrict motion, global float *restrict moved,
                 const int channels, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int pixel = y * width + x;
    const Taps at = taps(follow(motion[pixel], x, y, height, width), height, width);
    bilinear_all(plane, at, channels, moved + pixel * channels);
}

// Three numbers that are not the frame's last; the fourth lane is that of the next pixel.
INLINE float4 three_of(global const float *plane)
{
    return *(global const float4_anywhere *)plane;
}

// A row of a pixel's enlarged colours: from the row of `here` so far to that of `there`.
INLINE void enlarge_row(global const float *here, global const float *there, const float share, global float *out)
{
    const float4 left = LERP(three_of(here - 3), three_of(there - 3), share),
                 middle = LERP(three_of(here), three_of(there), share),
                 right = LERP(three_of(here + 3), three_of(there + 3), share);
    const float4 west = LERP(left, middle, 0.75f), east = LERP(middle, right, 0.25f);
    *(global float4_anywhere *)out = (float4)(west.xyz, east.x);
    *(global float2_anywhere *)(out + 4) = east.yz;
}

kernel void enlarge(global const float *restrict plane, global float *restrict enlarged, const int channels,
                    const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int west = x > 0 ? -channels : 0, east = x < width - 1 ? channels : 0;
    const int north = y > 0 ? -width * channels : 0, south = y < height - 1 ? width * channels : 0;
    if (channels == 3 && x > 0 && x < width - 2) {
        global const float *here = plane + (y * width + x) * 3;
        global float *out = enlarged + (4 * y * width + 2 * x) * 3;
        enlarge_row(here + north, here, 0.75f, out);
        enlarge_row(here, here + south, 0.25f, out + 6 * width);
        return;
    }
    for (int c = 0; c < channels; ++c) {
        global const float *restrict here = plane + (y * width + x) * channels + c;
        global float *restrict out = enlarged + (4 * y * width + 2 * x) * channels + c;
        // Down first, then across; 3/4 of the way from the row above, then 1/4 to the row below.
        for (int lower = 0; lower < 2; ++lower) {
            const int a = lower ? 0 : north, b = lower ? south : 0;
            const float share = lower ? 0.25f : 0.75f;
            const float left = LERP(here[a + west], here[b + west], share), middle = LERP(here[a], here[b], share),
                        right = LERP(here[a + east], here[b + east], share);
            out[0] = LERP(left, middle, 0.75f);
            out[channels] = LERP(middle, right, 0.25f);
            out += 2 * width * channels;
        }
    }
}

// Four numbers, and the four behind them if there are `two`.
INLINE float8 read_fours(global const float4 *from, const bool two)
{
    if (two) return *(global const float8_anywhere *)from;
    return (float8)(*from, (float4)(0.0f));
}

INLINE float8 clip(const float8 e)
{
    const float8 most = e > 1.0f ? (float8)(1.0f) : e;
    return most < 0.0f ? (float8)(0.0f) : most;
}

// The inverse of the sRGB curve, ((e + 0.055) / 1.055)^2.4 = 1.055^-2.4 s^2 s^0.4. The root q = (s^2)^(1/5) begins
// within 4 %, since an exponent is a logarithm; each step of Halley's method takes twice the third power of the error.
// The relative error is at most 10 x 2^-24: s brings 2.4 x 1.6, q 2, and the constant and three products 1 each.
INLINE float8 linear_of(const float8 e)
{
    const float8 s = e + 0.055f, square = s * s;
    float8 q = as_float8(trunc8(0.4f * float8_of(as_int8(s)) + 6.39e8f));
    for (int i = 0; i < 2; ++i) {
        const float8 fourth = (q * q) * (q * q), fifth = fourth * q;
        q += q * ((square - fifth) / (3.0f * fifth + 2.0f * square));
    }
    const float8 power = 0.879415461f * (square * q);
    const float8 bright = e < 1.0f ? power : (float8)(1.0f);  // white stays white
    return e <= 0.040449936f ? e * (1.0f / 12.92f) : bright;
}

kernel void decode(global const float4 *restrict image, global const float4 *restrict above,
                   global float4 *restrict color, global int *restrict bad, const int srgb, const int highlights,
                   const float low, const float span, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width) return;
    const int first = 6 * (y * width + x), all = 3 * height * width, end = first + 6 < all ? first + 6 : all;
    int8 infinite = 0;
    for (int i = first; i < end; i += 2) {
        const bool two = i + 1 < end;
        const float8 sample = read_fours(image + i, two);
        infinite |= (as_int8(sample) & EXPONENT) == EXPONENT;
        const float8 e = clip(sample);
        float8 c = srgb ? linear_of(e) : e;
        // White pixels have the whole of it, darker ones nothing.
        if (highlights) c += read_fours(above + i, two) * clip((e - low) / span);
        if (two)
            *(global float8_anywhere *)(color + i) = c;
        else
            color[i] = c.lo;
    }
    const int4 four = infinite.lo | infinite.hi;
    if (four.x | four.y | four.z | four.w) *bad = 1;
}
