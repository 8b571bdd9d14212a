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
// Launch (W, H) rounded up: a work-item has a pixel, or any twelve numbers of the image.
#include "sample.clh"

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

kernel void enlarge(global const float *restrict plane, global float *restrict enlarged, const int channels,
                    const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int west = x > 0 ? -channels : 0, east = x < width - 1 ? channels : 0;
    const int north = y > 0 ? -width * channels : 0, south = y < height - 1 ? width * channels : 0;
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

INLINE float4 clip(const float4 e)
{
    const float4 most = e > 1.0f ? (float4)(1.0f) : e;
    return most < 0.0f ? (float4)(0.0f) : most;
}

// The inverse of the sRGB curve, ((e + 0.055) / 1.055)^2.4 = 1.055^-2.4 s^2 s^0.4. The root q = (s^2)^(1/5) begins within
// 4 %, since an exponent is a logarithm; each step of Halley's method takes twice the third power of the error.
// The relative error is at most 10 x 2^-24: s brings 2.4 x 1.6, q 2, and the constant and three products 1 each.
INLINE float4 linear_of(const float4 e)
{
    const float4 s = e + 0.055f, square = s * s;
    float4 q = as_float4(convert_int4(0.4f * convert_float4(as_int4(s)) + 6.39e8f));
    for (int i = 0; i < 2; ++i) {
        const float4 fourth = (q * q) * (q * q), fifth = fourth * q;
        q += q * ((square - fifth) / (3.0f * fifth + 2.0f * square));
    }
    const float4 power = 0.879415461f * (square * q);
    const float4 bright = e < 1.0f ? power : (float4)(1.0f);  // white stays white
    return e <= 0.040449936f ? e * (1.0f / 12.92f) : bright;
}

kernel void decode(global const float4 *restrict image, global const float4 *restrict above,
                   global float4 *restrict color, global int *restrict bad, const int srgb, const int highlights,
                   const float low, const float span, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int first = (y * width + x) * 3;
    int4 infinite = 0;
    for (int i = first; i < first + 3; ++i) {
        infinite |= (as_int4(image[i]) & EXPONENT) == EXPONENT;
        const float4 e = clip(image[i]);
        float4 c = srgb ? linear_of(e) : e;
        // White pixels have the whole of it, darker ones nothing.
        if (highlights) c += above[i] * clip((e - low) / span);
        color[i] = c;
    }
    if (infinite.x | infinite.y | infinite.z | infinite.w) *bad = 1;
}
