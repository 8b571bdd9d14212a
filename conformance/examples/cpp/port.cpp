// SPDX-License-Identifier: MIT
// All stages of STSS in plain C++17: the program `port JOB` of docs/ports.md, to be read by somebody who writes one of their own.
//
// From top to bottom: images, the stages in image space, convolutions, the network's stages, a whole frame; then code that has nothing
// to do with STSS: .npy and safetensors files, the job folder. docs/stages.md says what each stage is for; a function has the
// stage's name. Everything is float32. In image space operations stand in the reference's order, so that its float32 results come
// out bit for bit; the network's sums are in another order, and differ in the last digits.
#include <algorithm>
#include <array>
#include <cctype>
#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <vector>

// The stages compare with NaN and look for infinity, and ties must stay ties. Neither survives fast-math; and a multiplication
// fused with an addition makes equal lengths unequal, hence -ffp-contract=off in the Makefile.
#ifdef __FAST_MATH__
#error "port.cpp needs a compiler that respects NaN: leave out -ffast-math"
#endif
static_assert(FLT_EVAL_METHOD == 0, "port.cpp needs arithmetic that is rounded to float after each operation");

namespace fs = std::filesystem;

// ---- Images ----

// (height, width, channels), indexed [y, x]; channels lie side by side, as in the files.
template <typename T>
struct Grid {
    int height, width, channels;
    std::vector<T> data;

    Grid(int h, int w, int c, T value = 0) : height(h), width(w), channels(c), data(size_t(h) * w * c, value) {}
    T *at(int y, int x) { return data.data() + (size_t(y) * width + x) * channels; }
    const T *at(int y, int x) const { return data.data() + (size_t(y) * width + x) * channels; }
    bool holds(int y, int x) const { return y >= 0 && y < height && x >= 0 && x < width; }
};
using Image = Grid<float>;
using Mask = Grid<uint8_t>;  // one channel, 0 or 1

// On a GPU, `pixel` is what one thread computes.
template <typename T, typename Pixel>
static void each_pixel(const Grid<T> &grid, Pixel pixel) {
    for (int y = 0; y < grid.height; ++y)
        for (int x = 0; x < grid.width; ++x) pixel(y, x);
}

// a + (b - a) t, not a (1 - t) + b t: a flat image then stays flat bit for bit, and t = 0 gives exactly a.
static float lerp(float a, float b, float t) { return a + (b - a) * t; }

static Image concat(const std::vector<const Image *> &images) {
    int channels = 0;
    for (const Image *image : images) channels += image->channels;
    Image result(images[0]->height, images[0]->width, channels);
    each_pixel(result, [&](int y, int x) {
        float *out = result.at(y, x);
        for (const Image *image : images) out = std::copy_n(image->at(y, x), image->channels, out);
    });
    return result;
}

static Image some_channels(const Image &image, int first, int count) {
    Image result(image.height, image.width, count);
    each_pixel(image, [&](int y, int x) { std::copy_n(image.at(y, x) + first, count, result.at(y, x)); });
    return result;
}

static Image relu(Image image) {
    for (float &value : image.data) value = value > 0.0f ? value : 0.0f;
    return image;
}

static Image times_mask(Image image, const Image &mask) {
    each_pixel(image, [&](int y, int x) {
        for (int c = 0; c < image.channels; ++c) image.at(y, x)[c] *= *mask.at(y, x);
    });
    return image;
}

// ---- Reading where a motion leads ----

static bool is_finite(const float *motion) { return std::isfinite(motion[0]) && std::isfinite(motion[1]); }

// Where a motion leads along one axis: a whole pixel, not clamped into the frame, and a fraction of the way to the next.
struct Along {
    int whole;
    float fraction;

    // Never p + motion, a sum that is rounded. Beyond the frame is beyond it, however far: an integer holds no huge number.
    Along(int p, float motion, int side) {
        const float down = std::floor(motion);
        whole = p + int(std::clamp(down, float(-side - 1), float(side + 1)));
        fraction = motion - down;
    }
    bool inside(int side) const { return whole >= 0 && whole + (fraction > 0.0f) <= side - 1; }
};

struct Place {
    Along x, y;
    bool finite;
};

// Where a motion of pixel (x, y) leads, in a frame of this size. One that is not finite leads to the pixel itself, off screen.
static Place follow(const float *motion, int y, int x, int height, int width) {
    const bool finite = is_finite(motion);
    return {Along(x, finite ? motion[0] : 0.0f, width), Along(y, finite ? motion[1] : 0.0f, height), finite};
}

static Place follow(const Image &motion, int y, int x) { return follow(motion.at(y, x), y, x, motion.height, motion.width); }

static bool leads_inside(const Place &to, const Image &frame) {
    return to.finite && to.x.inside(frame.width) && to.y.inside(frame.height);
}

struct Taps {
    int x0, y0, x1, y1;
    float fx, fy;
};

// The four pixels around a place, the place clamped into the frame first. Clamped, or in the last column or row, it lies on a pixel.
static Taps taps(const Place &to, int height, int width) {
    const int x0 = std::clamp(to.x.whole, 0, width - 1), y0 = std::clamp(to.y.whole, 0, height - 1);
    return {x0, y0, std::min(x0 + 1, width - 1), std::min(y0 + 1, height - 1),
            to.x.whole >= 0 && to.x.whole < width - 1 ? to.x.fraction : 0.0f,
            to.y.whole >= 0 && to.y.whole < height - 1 ? to.y.fraction : 0.0f};
}

static float bilinear(const Image &image, const Taps &at, int channel) {
    const float top = lerp(image.at(at.y0, at.x0)[channel], image.at(at.y0, at.x1)[channel], at.fx);
    const float bottom = lerp(image.at(at.y1, at.x0)[channel], image.at(at.y1, at.x1)[channel], at.fx);
    return lerp(top, bottom, at.fy);
}

// ---- Stage motion_chain ----

// Towards zero, not floor: half a pixel left of the frame still reads column 0. Farther left floor reads 0 as well.
static int truncated(const Along &to) { return to.whole == -1 && to.fraction > 0.0f ? 0 : to.whole; }

// The longest of the 2 x 2 motions whose corner is trunc(p + m), but 0 where any of them is 0; outside the frame all are.
static std::array<float, 2> gather(const Image &motion, const Place &to) {
    if (!to.finite) return {0.0f, 0.0f};
    const int x0 = truncated(to.x), y0 = truncated(to.y);
    std::array<float, 2> longest{};
    float length = -1.0f;
    for (int j = 0; j < 2; ++j)
        for (int i = 0; i < 2; ++i) {
            if (!motion.holds(y0 + j, x0 + i)) return {0.0f, 0.0f};
            const float *m = motion.at(y0 + j, x0 + i);
            if (m[0] == 0.0f && m[1] == 0.0f) return {0.0f, 0.0f};  // wins even over one that is not finite
            const float here = is_finite(m) ? m[0] * m[0] + m[1] * m[1] : INFINITY;
            if (!(here > length)) continue;  // strictly longer: among equals the first in raster order stays
            length = here;
            longest = {m[0], m[1]};
        }
    return longest;
}

// One frame further back: m_{j+1}(p) = m_j(p) + gather(earlier, p + m_j(p)). A motion that is not finite stays so.
static Image chain_step(const Image &chained, const Image &earlier) {
    Image next(chained.height, chained.width, 2);
    each_pixel(next, [&](int y, int x) {
        const float *m = chained.at(y, x);
        const auto further = gather(earlier, follow(chained, y, x));
        next.at(y, x)[0] = m[0] + further[0];
        next.at(y, x)[1] = m[1] + further[1];
    });
    return next;
}

static Image motion_chain(const std::vector<Image> &motions) {
    Image chained = motions[0];
    for (size_t j = 1; j < motions.size(); ++j) chained = chain_step(chained, motions[j]);
    return chained;
}

// ---- Stage warp ----

static std::pair<Image, Mask> warp(const Image &color, const Image &motion) {
    Image warped(color.height, color.width, color.channels);
    Mask inside(color.height, color.width, 1);
    each_pixel(color, [&](int y, int x) {
        const Place to = follow(motion, y, x);
        const Taps at = taps(to, color.height, color.width);
        // Off screen too: nothing is blanked, the nearest border pixel is read.
        for (int c = 0; c < color.channels; ++c) warped.at(y, x)[c] = bilinear(color, at, c);
        *inside.at(y, x) = leads_inside(to, motion);
    });
    return {warped, inside};
}

// ---- Stage holes ----

constexpr float FOOTPRINTS = 1.5f, FACING = 7.5f, GRAZING = 45.0f, PER_DEPTH = 50.0f, MESH = 1.0f;  // three in cm
constexpr float COSINE = 0.98f, STATIC_COSINE = 0.5f;

// The values of the current frame and of an earlier one that the hole test reads.
struct Surface {
    Image stencil, normal, position;
};

// The test of static surfaces: by the footprint, or the paper's, for weights that were trained with it.
enum class HoleTest { footprint, paper };

static float squared(float dx, float dy, float dz) { return dx * dx + dy * dy + dz * dz; }

static float squared_distance(const float *a, const float *b) { return squared(a[0] - b[0], a[1] - b[1], a[2] - b[2]); }

// The paper's test: whether any of the four taps is further away than `bias`, also those whose weight is 0.
static bool is_far(const Image &previous, const float *position, const Taps &at, float bias) {
    for (const int y : {at.y0, at.y1})
        for (const int x : {at.x0, at.x1})
            // Not `distance > bias`, which is false for NaN; nor a maximum of the four, which may drop one.
            if (!(std::sqrt(squared_distance(previous.at(y, x), position)) <= bias)) return true;
    return false;
}

// A footprint's square along one axis: to the nearer of the two neighbours that lie in the frame and are finite; 0 without one.
static float nearer(const Image &position, int y, int x, int down, int right) {
    float nearest = INFINITY;
    for (const int side : {-1, 1}) {
        if (!position.holds(y + side * down, x + side * right)) continue;
        const float apart = squared_distance(position.at(y + side * down, x + side * right), position.at(y, x));
        if (apart < nearest) nearest = apart;  // false for NaN
    }
    return nearest < INFINITY ? nearest : 0.0f;
}

// Whether the offset from this position to the earlier one, read as the colour is, exceeds the footprints allowed; so does NaN.
static bool is_beyond(const Image &previous, const Image &position, const Taps &at, int y, int x) {
    float offset[3];
    const float *here = position.at(y, x);
    for (int c = 0; c < 3; ++c) {
        const auto tap = [&](int row, int column) { return previous.at(row, column)[c] - here[c]; };
        // Offsets, and not positions, are read between: far from the origin a position has lost the digits that count.
        const float top = lerp(tap(at.y0, at.x0), tap(at.y0, at.x1), at.fx), bottom = lerp(tap(at.y1, at.x0), tap(at.y1, at.x1), at.fx);
        offset[c] = lerp(top, bottom, at.fy);
    }
    const float reach = FOOTPRINTS * FOOTPRINTS * (nearer(position, y, x, 0, 1) + nearer(position, y, x, 1, 0));
    return !(squared(offset[0], offset[1], offset[2]) <= reach);
}

static Mask holes(const Image &motion, const Surface &previous, const Surface &current, const Image &nov, const Image &depth,
                  HoleTest test) {
    Mask valid(motion.height, motion.width, 1);
    each_pixel(valid, [&](int y, int x) {
        const Place to = follow(motion, y, x);
        const Taps at = taps(to, motion.height, motion.width);
        const float s = bilinear(previous.stencil, at, 0);
        const float n[] = {bilinear(previous.normal, at, 0), bilinear(previous.normal, at, 1), bilinear(previous.normal, at, 2)};
        const float *normal = current.normal.at(y, x);

        const float facing = std::fabs(*nov.at(y, x));
        const float bias = FACING * facing + GRAZING * (1.0f - facing) + PER_DEPTH * *depth.at(y, x);
        // Only the warped normal is divided by its length, and only after it was interpolated.
        const float length = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
        const float cosine = (normal[0] * n[0] + normal[1] * n[1] + normal[2] * n[2]) / (length + 1e-5f);
        const bool surface = normal[0] != 0 || normal[1] != 0 || normal[2] != 0 || n[0] != 0 || n[1] != 0 || n[2] != 0;
        const bool moving = s != 0.0f && cosine < COSINE && surface;
        // s == 0 exactly, of the interpolated stencil: false at the edge of a moving object.
        const bool is_static = s == 0.0f && (test == HoleTest::paper ? is_far(previous.position, current.position.at(y, x), at, bias)
                                                                     : is_beyond(previous.position, current.position, at, y, x) ||
                                                                           (cosine < STATIC_COSINE && surface));

        const bool mesh = 3.0f * std::fabs(s - *current.stencil.at(y, x)) > MESH;
        *valid.at(y, x) = leads_inside(to, motion) && !is_static && !moving && !mesh;
    });
    return valid;
}

// ---- Stage occlusion_warp ----

// Every pixel's motion written to the four earlier pixels around the place it came from; the nearest surface stays.
static Image splat(const Image &motion, const Image &depth) {
    Image earlier(motion.height, motion.width, 2);  // 0 where nobody writes
    Image nearest(motion.height, motion.width, 1, 10.0f);
    each_pixel(motion, [&](int y, int x) {
        const Place to = follow(motion, y, x);
        if (!to.finite) return;
        const int x0 = to.x.whole, y0 = to.y.whole;  // floor here, trunc in the chain: from -1 the right and lower neighbours still lie in the frame
        for (int j = 0; j < 2; ++j)
            for (int i = 0; i < 2; ++i) {
                // Strictly nearer: among equal depths the first in raster order stays. Threads get the same result by an atomic
                // minimum over (depth, raster index) in 64 bits.
                if (!earlier.holds(y0 + j, x0 + i) || !(*depth.at(y, x) < *nearest.at(y0 + j, x0 + i))) continue;
                *nearest.at(y0 + j, x0 + i) = *depth.at(y, x);
                std::copy_n(motion.at(y, x), 2, earlier.at(y0 + j, x0 + i));
            }
    });
    return earlier;
}

// Gives occlusion_motion and occlusion_warp.
static std::pair<Image, Image> occlusion_warp(const Image &color, const Image &warped, const Image &motion, const Image &depth,
                                              const Mask &valid) {
    const Image splatted = splat(motion, depth);
    Image occlusion_motion(color.height, color.width, 2), filled = warped;
    each_pixel(color, [&](int y, int x) {
        const Place to = follow(motion, y, x);
        const Taps lookup = taps(to, color.height, color.width);
        const float *m = splatted.at(lookup.y0, lookup.x0);  // one pixel, no interpolation
        std::copy_n(m, 2, occlusion_motion.at(y, x));
        if (*valid.at(y, x)) return;
        // The earlier colour at p plus the new motion, not at the place of the lookup.
        const Taps at = taps(follow(m, y, x, color.height, color.width), color.height, color.width);
        for (int c = 0; c < color.channels; ++c) filled.at(y, x)[c] = bilinear(color, at, c);
    });
    return {occlusion_motion, filled};
}

// ---- Stage reshade ----

constexpr float OWN_FOOTPRINTS = 2.0f, OWN_COSINE = 0.95f, OWN_STATIC_COSINE = 0.5f;
constexpr float NORMAL = 2.0f, DISTANCE = 0.25f, FLOOR = 0.015625f, UNMIXED = 0.25f;
constexpr int LIGHT_REACH = 2;  // pixels from a hole to the sides of the square of holes whose mean light it takes
constexpr int REACH = 2, STEPS[] = {1, 2, 4, 8, 16, 32};  // places from a hole to the sides of a ring; pixels from place to place

static bool is_none(const float *normal) { return normal[0] == 0.0f && normal[1] == 0.0f && normal[2] == 0.0f; }

// Whether the earlier pixel (v, u) shows the surface of the pixel (y, x).
static bool shows_surface(const Surface &previous, int v, int u, const Surface &current, int y, int x) {
    if (*previous.stencil.at(v, u) != *current.stencil.at(y, x)) return false;
    const float *n = previous.normal.at(v, u), *normal = current.normal.at(y, x);
    if (is_none(n) && is_none(normal)) return true;  // a background
    const float cosine = normal[0] * n[0] + normal[1] * n[1] + normal[2] * n[2];
    if (*current.stencil.at(y, x) != 0.0f) return cosine >= OWN_COSINE;
    if (!(cosine >= OWN_STATIC_COSINE)) return false;
    const float footprint = nearer(current.position, y, x, 0, 1) + nearer(current.position, y, x, 1, 0);
    return squared_distance(previous.position.at(v, u), current.position.at(y, x)) <= OWN_FOOTPRINTS * OWN_FOOTPRINTS * footprint;
}

// How alike two materials are, 0 to 1; of a background `away` counts, the squared distance in pixels.
static float likeness(const float *base_color, const float *own_base_color, const float *normal, const float *own_normal, int away) {
    if (is_none(normal) != is_none(own_normal)) return 0.0f;
    float apart = 0.0f;
    for (int c = 0; c < 3; ++c) apart += std::fabs(base_color[c] - own_base_color[c]);
    float unlike = 1.0f + apart + NORMAL * squared_distance(normal, own_normal);
    if (is_none(own_normal)) unlike += DISTANCE * static_cast<float>(away);
    const float square = unlike * unlike;
    return 1.0f / (square * square);
}

static bool is_mixed(const float *normal) {
    return normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2] < UNMIXED;
}

// The display-referred colour of a base colour in light 1, one channel; 1 for holes whose own base colour is a mean with a background's.
static float brightness(float base_color, bool mixed) {
    return mixed ? 1.0f : std::sqrt(std::min(std::max(base_color, 0.0f), 1.0f) + FLOOR);
}

// `base_color` is that of the frame itself.
static Image reshade(const Image &color, const Image &warped, const Image &motion, const Mask &valid, const Surface &previous,
                     const Surface &current, const Image &base_color) {
    Image filled = warped;
    for (float &value : filled.data) value = std::max(value, 0.0f);
    // First the holes that have samples of their own: they are sources for the others. Not the four taps of a bilinear reading:
    // pixels outside the frame are no samples.
    Mask source = valid;
    each_pixel(filled, [&](int y, int x) {
        const Place to = follow(motion, y, x);
        if (*valid.at(y, x) || !to.finite) return;
        float sum[3] = {}, count = 0.0f;
        for (const int v : {to.y.whole, to.y.whole + 1})
            for (const int u : {to.x.whole, to.x.whole + 1}) {
                if (!color.holds(v, u) || !shows_surface(previous, v, u, current, y, x)) continue;
                for (int c = 0; c < 3; ++c) sum[c] += std::max(color.at(v, u)[c], 0.0f);
                count += 1.0f;
            }
        if (count == 0.0f) return;
        for (int c = 0; c < 3; ++c) filled.at(y, x)[c] = sum[c] / count;
        *source.at(y, x) = 1;
    });
    // A moving object's samples are known by their normals alone: its holes look around, too.
    Image light(color.height, color.width, 3);
    Mask has_light = valid;
    std::fill(has_light.data.begin(), has_light.data.end(), uint8_t(0));
    each_pixel(filled, [&](int y, int x) {
        if (*valid.at(y, x) || (*source.at(y, x) && *current.stencil.at(y, x) == 0.0f)) return;
        const float *normal = current.normal.at(y, x);
        const bool mixed = is_mixed(normal);
        float sum[3] = {}, total[3] = {};
        for (const int step : STEPS)
            for (int j = -REACH; j <= REACH; ++j)
                for (int i = -REACH; i <= REACH; i += std::abs(j) == REACH ? 1 : 2 * REACH) {
                    const int v = y + step * j, u = x + step * i;
                    if (!source.holds(v, u) || !*source.at(v, u) || *current.stencil.at(v, u) != *current.stencil.at(y, x)) continue;
                    const float weight = likeness(base_color.at(v, u), base_color.at(y, x), current.normal.at(v, u),
                                                  normal, (u - x) * (u - x) + (v - y) * (v - y));
                    for (int c = 0; c < 3; ++c) {
                        const float a = brightness(base_color.at(v, u)[c], mixed);
                        sum[c] += weight * a * filled.at(v, u)[c];
                        total[c] += weight * a * a;
                    }
                }
        if (!(std::min({total[0], total[1], total[2]}) > 0.0f)) return;
        for (int c = 0; c < 3; ++c) light.at(y, x)[c] = sum[c] / total[c];
        *has_light.at(y, x) = 1;
    });
    // Each hole looks at other places: the mean of neighbours' lights has no streaks.
    each_pixel(filled, [&](int y, int x) {
        if (!*has_light.at(y, x)) return;
        const float *normal = current.normal.at(y, x);
        float sum[3] = {}, total = 0.0f;
        for (int v = y - LIGHT_REACH; v <= y + LIGHT_REACH; ++v)
            for (int u = x - LIGHT_REACH; u <= x + LIGHT_REACH; ++u) {
                if (!source.holds(v, u) || !*has_light.at(v, u) || *current.stencil.at(v, u) != *current.stencil.at(y, x)) continue;
                if (is_mixed(current.normal.at(v, u)) != is_mixed(normal)) continue;
                const float weight = likeness(base_color.at(v, u), base_color.at(y, x), current.normal.at(v, u), normal, 0);
                for (int c = 0; c < 3; ++c) sum[c] += weight * light.at(v, u)[c];
                total += weight;
            }
        for (int c = 0; c < 3; ++c)
            filled.at(y, x)[c] = brightness(base_color.at(y, x)[c], is_mixed(normal)) * sum[c] / total;
    });
    return filled;
}

// ---- Stage rrm ----

// `rectangle` is y, x, height, width, and lies within the mask.
static Mask rrm(Mask valid, const std::vector<int32_t> &rectangle) {
    for (int y = 0; y < rectangle[2]; ++y) std::fill_n(valid.at(rectangle[0] + y, rectangle[1]), rectangle[3], uint8_t(0));
    return valid;
}

// ---- Stage accumulate ----

constexpr float EARLIER_SHARES[] = {0.25f, 0.125f};
constexpr float SLOW = 4.0f;  // pixels: beyond, an image keeps less of its share

// An image mixed with those of the one or two display frames before it. `motions` lead there from the low-resolution pixels, half as
// many along each side.
static Image accumulate(const Image &image, const std::vector<Image> &earlier, const std::vector<Image> &motions) {
    Image shown = image;
    each_pixel(image, [&](int y, int x) {
        std::vector<float> low(image.at(y, x), image.at(y, x) + image.channels), high = low, total(image.channels);
        for (int v = std::max(y - 1, 0); v <= std::min(y + 1, image.height - 1); ++v)
            for (int u = std::max(x - 1, 0); u <= std::min(x + 1, image.width - 1); ++u)
                for (int c = 0; c < image.channels; ++c) {
                    low[c] = std::min(low[c], image.at(v, u)[c]);
                    high[c] = std::max(high[c], image.at(v, u)[c]);
                }
        for (size_t k = 0; k < earlier.size(); ++k) {
            const float *m = motions[k].at(y / 2, x / 2);
            const float moved[] = {2.0f * m[0], 2.0f * m[1]};
            const Place to = follow(moved, y, x, image.height, image.width);
            if (!leads_inside(to, image)) continue;
            const Taps at = taps(to, image.height, image.width);
            const float share = EARLIER_SHARES[k] * SLOW * SLOW / std::max(m[0] * m[0] + m[1] * m[1], SLOW * SLOW);
            for (int c = 0; c < image.channels; ++c)
                total[c] += (std::clamp(bilinear(earlier[k], at, c), low[c], high[c]) - image.at(y, x)[c]) * share;
        }
        for (int c = 0; c < image.channels; ++c) shown.at(y, x)[c] += total[c];
    });
    return shown;
}

// ---- Convolution ----

// A fault of a job: one line that names the file, and status 2.
[[noreturn]] static void refuse(const fs::path &path, const std::string &what) {
    throw std::runtime_error(path.string() + ": " + what);
}

// Output channels that are computed together: a loop over them becomes vector instructions. Weights of channels beyond the
// last are 0, and their results are not written.
constexpr int LANES = 8;

struct Layer {
    int inputs, outputs, kernel;
    std::vector<float> weight;  // [outputs / LANES, rounded up][kernel][kernel][inputs][LANES]
    std::vector<float> bias;    // [outputs, rounded up to LANES]

    // From the file's order (output, input, row, column): done once for a file, not for a case.
    Layer(const std::vector<float> &tensor, const std::vector<float> &biases, size_t c_in, size_t side)
        : inputs(int(c_in)), outputs(int(biases.size())), kernel(int(side)), bias(biases) {
        bias.resize((bias.size() + LANES - 1) / LANES * LANES);
        weight.resize(bias.size() * side * side * c_in);
        for (size_t from = 0; from < tensor.size(); ++from) {
            const size_t tap = from % (side * side), c = from / (side * side) % c_in, o = from / (side * side * c_in);
            weight[((o / LANES * side * side + tap) * c_in + c) * LANES + o % LANES] = tensor[from];
        }
    }
};

struct Weights {
    fs::path file;
    std::map<std::string, Layer> layers;  // by the tensors' names, less .weight and .bias
    bool detail = false;                  // the network's second colour is what warped frames show within a pixel
    HoleTest test = HoleTest::footprint;
    bool reshades = false;  // stage reshade fills the holes, not occlusion_warp

    const Layer &layer(const std::string &name, int inputs) const {
        const auto found = layers.find(name);
        if (found == layers.end()) refuse(file, name + ".weight: missing");
        if (found->second.inputs != inputs) refuse(file, name + ".weight: expected " + std::to_string(inputs) + " inputs");
        return found->second;
    }
};

// Cross-correlation: the kernel is not flipped. With stride 2, output i is centred at input 2i.
static Image conv(const Image &x, const Weights &weights, const std::string &name, int stride) {
    const Layer &layer = weights.layer(name, x.channels);
    // Zeros on all four sides, in every convolution; not the repeated border of pad_to_8.
    const int border = layer.kernel / 2;
    // On the right there are more, for the pixels of the last four that lie beyond the row.
    Image padded(x.height + 2 * border, x.width + 2 * border + 3 * stride, x.channels);
    each_pixel(x, [&](int y, int column) { std::copy_n(x.at(y, column), x.channels, padded.at(y + border, column + border)); });

    Image result((x.height + stride - 1) / stride, (x.width + stride - 1) / stride, layer.outputs);
    const int step = stride * layer.inputs;
    for (int first = 0; first < layer.outputs; first += LANES)
        for (int y = 0; y < result.height; ++y)
            // Four pixels at a time: a weight is fetched once for all, and none waits for another's sum. Each has a name, since g++ -O2
            // keeps an array of them in memory.
            for (int column = 0; column < result.width; column += 4) {
                const float *weight = layer.weight.data() + size_t(first) * layer.kernel * layer.kernel * layer.inputs;
                float sums[4][LANES];
                for (float *sum : {sums[0], sums[1], sums[2], sums[3]}) std::copy_n(layer.bias.data() + first, LANES, sum);
                for (int v = 0; v < layer.kernel; ++v)
                    for (int u = 0; u < layer.kernel; ++u) {
                        const float *in = padded.at(y * stride + v, column * stride + u);
                        // A sum for each tap, then a sum of those: less rounding than in one long sum.
                        float tap0[LANES] = {}, tap1[LANES] = {}, tap2[LANES] = {}, tap3[LANES] = {};
                        const auto add = [&](float *tap, float value) {
                            for (int lane = 0; lane < LANES; ++lane) tap[lane] += value * weight[lane];
                        };
                        for (int c = 0; c < layer.inputs; ++c, ++in, weight += LANES) {
                            add(tap0, in[0]);
                            add(tap1, in[step]);
                            add(tap2, in[2 * step]);
                            add(tap3, in[3 * step]);
                        }
                        float *sum = sums[0];
                        for (const float *tap : {tap0, tap1, tap2, tap3})
                            for (int lane = 0; lane < LANES; ++lane) *sum++ += tap[lane];
                    }
                for (int i = 0; i < std::min(4, result.width - column); ++i)
                    std::copy_n(sums[i], std::min(LANES, layer.outputs - first), result.at(y, column + i) + first);
            }
    return result;
}

// Without overflow, and accurate in both tails.
static float sigmoid(float x) {
    const float small = std::exp(-std::fabs(x));
    return (x >= 0.0f ? 1.0f : small) / (1.0f + small);
}

// The results of layers, for the judge to name the one at which a wrong answer begins; nothing is kept unless a case asks for it (run_case).
// Of a layer that runs for each of the three earlier frames there are three.
static std::map<std::string, std::vector<Image>> *layers_asked = nullptr;

static Image seen(const std::string &name, Image x) {
    if (layers_asked) (*layers_asked)[name].push_back(x);
    return x;
}

// conv(x) * sigmoid(gate(x)); ReLU, where there is one, comes after the product.
static Image gated(const Image &x, const Weights &weights, const std::string &name, int stride = 1) {
    Image gate = conv(x, weights, name + ".conv_mask.0", stride);
    for (float &value : gate.data) value = sigmoid(value);
    return times_mask(conv(x, weights, name + ".conv_feature", stride), gate);
}

// Convolutions name.0, name.2, ... with ReLU between them; `strides` has one number for each.
static Image conv_chain(Image x, const Weights &weights, const std::string &name, const std::vector<int> &strides,
                        bool last_relu = true) {
    for (size_t i = 0; i < strides.size(); ++i) {
        const std::string layer = name + "." + std::to_string(2 * i);
        x = conv(x, weights, layer, strides[i]);
        if (last_relu || i + 1 < strides.size()) x = relu(std::move(x));
        x = seen(layer, std::move(x));
    }
    return x;
}

// ---- Changes of size ----

// The reading of an output row or column: two input rows or columns, and its place between them.
struct Between {
    int low, high;
    float t;
};

// Corner pixels aligned: output o of 2n reads o (n - 1) / (2n - 1). In integers, so that no rounding leads across a pixel.
static std::vector<Between> corners(int n) {
    std::vector<Between> places;
    const int64_t over = 2 * int64_t(n) - 1;
    for (int64_t o = 0, at = 0; o <= over; ++o, at += n - 1)
        places.push_back({int(at / over), std::min(int(at / over) + 1, n - 1), float(at % over) / float(over)});
    return places;
}

// Pixel centres aligned: output o reads (o + 1/2)/2 - 1/2, clamped into the axis: weights 1/4 and 3/4.
static std::vector<Between> centres(int n) {
    std::vector<Between> places;
    for (int o = 0; o < 2 * n; ++o) {
        const float at = std::clamp((float(o) + 0.5f) / 2.0f - 0.5f, 0.0f, float(n - 1));
        places.push_back({int(at), std::min(int(at) + 1, n - 1), at - std::floor(at)});
    }
    return places;
}

static Image resample(const Image &x, const std::vector<Between> &rows, const std::vector<Between> &columns) {
    Image result(int(rows.size()), int(columns.size()), x.channels);
    each_pixel(result, [&](int y, int column) {
        const Between &r = rows[y], &k = columns[column];
        for (int c = 0; c < x.channels; ++c) {
            const float left = lerp(x.at(r.low, k.low)[c], x.at(r.high, k.low)[c], r.t);
            const float right = lerp(x.at(r.low, k.high)[c], x.at(r.high, k.high)[c], r.t);
            result.at(y, column)[c] = lerp(left, right, k.t);
        }
    });
    return result;
}

// Aligned corners occur in the decoder's three upsamplings only; the colour that is added to the image has aligned centres.
static Image upsample_corners(const Image &x) { return resample(x, corners(x.height), corners(x.width)); }
static Image upsample_centres(const Image &x) { return resample(x, centres(x.height), centres(x.width)); }

// The mean of the four pixels in the middle of each 8 x 8 block; no prefilter.
static Image downsample_8(const Image &x) {
    Image result(x.height / 8, x.width / 8, x.channels);
    each_pixel(result, [&](int y, int column) {
        const float *top = x.at(8 * y + 3, 8 * column + 3), *bottom = x.at(8 * y + 4, 8 * column + 3);
        for (int c = 0, right = x.channels; c < x.channels; ++c, ++right)
            result.at(y, column)[c] = ((top[c] + bottom[c]) * 0.5f + (top[right] + bottom[right]) * 0.5f) * 0.5f;
    });
    return result;
}

// (H, W, 4C) -> (2H, 2W, C): among a pixel's input channels the colour is the slowest index, the column the fastest.
static Image pixel_shuffle(const Image &x) {
    Image result(2 * x.height, 2 * x.width, x.channels / 4);
    each_pixel(result, [&](int y, int column) {
        for (int c = 0; c < result.channels; ++c)
            result.at(y, column)[c] = x.at(y / 2, column / 2)[4 * c + 2 * (y % 2) + column % 2];
    });
    return result;
}

// Below and right only, by repeating the last row and column; by none where the size is a multiple of 8 already.
static Image pad_to_8(const Image &x) {
    Image padded((x.height + 7) / 8 * 8, (x.width + 7) / 8 * 8, x.channels);
    each_pixel(padded, [&](int y, int column) {
        std::copy_n(x.at(std::min(y, x.height - 1), std::min(column, x.width - 1)), x.channels, padded.at(y, column));
    });
    return padded;
}

// ---- Stage history ----

// `frames` are oldest, middle, newest, which pass through the same weights.
static Image history(std::vector<Image> frames, const Weights &weights) {
    for (Image &x : frames)
        for (const char *name : {"convHis1", "convHis2", "convHis3"}) x = conv_chain(std::move(x), weights, name, {2, 1, 1});
    return seen("lowlevelGated", gated(concat({&frames[0], &frames[1], &frames[2]}), weights, "lowlevelGated"));  // no ReLU
}

// ---- Stage encoder ----

static Image gated_relu(const Image &x, const Weights &weights, const std::string &name) {
    return seen(name, relu(gated(x, weights, name)));
}

static Image down(const Image &x, const Weights &weights, const std::string &name) {
    const Image half = seen(name + ".downsample", gated(x, weights, name + ".downsample", 2));  // no ReLU
    return gated_relu(gated_relu(half, weights, name + ".conv1"), weights, name + ".conv2");
}

// Gives x1, x2, x3, x4: at full, 1/2, 1/4 and 1/8 size.
static std::array<Image, 4> encoder(const Image &color, const Image &gbuffer, const Image &mask, const Weights &weights) {
    const Image trusted = times_mask(color, mask);  // all six channels
    const Image x = concat({&color, &trusted, &gbuffer});
    const Image x1 = gated_relu(gated_relu(x, weights, "conv1"), weights, "conv2");
    const Image x2 = down(x1, weights, "down1"), x3 = down(x2, weights, "down2"), x4 = down(x3, weights, "down3");
    return {x1, x2, x3, x4};
}

// ---- Stage erm ----

static Image normalised(Image x) {
    each_pixel(x, [&](int y, int column) {
        float *values = x.at(y, column);
        float squares = 0.0f;
        for (int c = 0; c < x.channels; ++c) squares += values[c] * values[c];
        for (int c = 0; c < x.channels; ++c) values[c] /= std::max(std::sqrt(squares), 1e-12f);
    });
    return x;
}

// The mean of the values in a window of 5 x 5, weighted by how alike the key there and the query here are.
static Image attend(const Image &query, const Image &key, const Image &value) {
    Image result(query.height, query.width, value.channels);
    each_pixel(result, [&](int y, int x) {
        float *total = result.at(y, x);
        float weight_sum = 0.0f;
        for (int v = y - 2; v <= y + 2; ++v)
            for (int u = x - 2; u <= x + 2; ++u) {
                if (!key.holds(v, u)) continue;  // outside the padded frame all is 0, and adds nothing to either sum
                float weight = 0.0f;
                for (int c = 0; c < key.channels; ++c) weight += key.at(v, u)[c] * query.at(y, x)[c];
                weight = std::max(weight, 0.0f);
                for (int c = 0; c < value.channels; ++c) total[c] += weight * value.at(v, u)[c];
                weight_sum += weight;
            }
        for (int c = 0; c < value.channels; ++c) total[c] /= std::max(weight_sum, 1e-6f);
    });
    return result;
}

static Image erm(const Image &x4, const Image &gbuffer, const Image &mask, const Weights &weights) {
    const Image f = downsample_8(gbuffer), m = downsample_8(mask);  // the mask becomes 0, 1/4, 1/2, 3/4 or 1
    const Image light = times_mask(conv_chain(concat({&x4, &f}), weights, "latentEncoder", {1, 1, 1}, false), m);
    const Image material = normalised(conv_chain(f, weights, "KEncoder", {1, 1, 1}, false));
    return attend(material, times_mask(material, m), light);  // the query is not masked
}

// ---- Stage decoder ----

static Image decoder(const Image &reshaded, const Image &feature, const Image &x1, const Image &x2, const Image &x3,
                     const Image &color, const Weights &weights) {
    Image u = concat({&reshaded, &feature});
    const std::pair<std::string, const Image *> levels[] = {{"up1", &x3}, {"up2", &x2}, {"up3", &x1}};
    for (const auto &[name, skip] : levels) {
        u = upsample_corners(u);
        u = conv_chain(concat({skip, &u}), weights, name + ".conv.double_conv", {1, 1});
    }
    Image image = pixel_shuffle(seen("outc", conv(u, weights, "outc", 1)));
    if (image.channels != 3) refuse(weights.file, "outc.weight: expected 12 outputs");
    const Image base = upsample_centres(some_channels(color, 0, 3));
    for (size_t i = 0; i < image.data.size(); ++i) image.data[i] += base.data[i];
    return image;  // not clipped
}

// ---- Stage network ----

// Any size: padded to multiples of 8, and the image cropped again.
static Image network(const Image &color, const Image &gbuffer, const Image &mask, const std::vector<Image> &frames,
                     const Weights &weights) {
    const Image c = pad_to_8(color), g = pad_to_8(gbuffer), m = pad_to_8(mask);
    const auto [x1, x2, x3, x4] = encoder(c, g, m, weights);
    const Image feature = history({pad_to_8(frames[0]), pad_to_8(frames[1]), pad_to_8(frames[2])}, weights);
    const Image reshaded = seen("reshaded", erm(x4, g, m, weights));
    const Image padded = decoder(reshaded, feature, x1, x2, x3, c, weights);
    Image image(2 * color.height, 2 * color.width, 3);
    each_pixel(image, [&](int y, int x) { std::copy_n(padded.at(y, x), 3, image.at(y, x)); });
    return image;
}

// ---- Stage frame ----

struct FrameInputs {
    std::vector<Image> colors;   // 3, newest first
    std::vector<int32_t> steps;  // 3: how many display frames back each lies; not decreasing
    std::vector<Image> motions;  // of the frame itself, the one before it, ...
    Image gbuffer, nov;
    std::vector<Surface> surfaces;  // 4: of the frame itself, then of `colors`
};

// A frame that is warped: its colour, the motion to it, and its object numbers.
struct Warp {
    const Image *color;
    Image motion;
    const Image *stencil;
};

static float luma(const float *c) { return 0.299f * c[0] + 0.587f * c[1] + 0.114f * c[2]; }

static float tent(float distance) { return std::max(0.0f, 1.0f - 2.0f * std::fabs(distance)); }

// The second colour "detail": each sample of the same object within half a pixel of a quarter's middle counts there, and so does the first colour.
static void show_detail(const std::vector<Warp> &warps, const Image &stencil, Image &color) {
    each_pixel(color, [&](int y, int x) {
        float *const c = color.at(y, x), own = luma(c), lumas[4];
        for (int q = 0; q < 4; ++q) {
            float sum = 0.25f * own, total = 0.25f;
            for (const Warp &w : warps) {
                const Place to = follow(w.motion, y, x);
                if (!leads_inside(to, color)) continue;
                const Taps at = taps(to, color.height, color.width);
                const float right = at.fx + (q % 2 ? 0.25f : -0.25f), down = at.fy + (q / 2 ? 0.25f : -0.25f);
                for (int tap = 0; tap < 4; ++tap) {
                    const int ty = tap / 2 ? at.y1 : at.y0, tx = tap % 2 ? at.x1 : at.x0;
                    if (*w.stencil->at(ty, tx) != *stencil.at(y, x)) continue;
                    const float weight = tent(right - float(tap % 2)) * tent(down - float(tap / 2));
                    sum += weight * luma(w.color->at(ty, tx));
                    total += weight;
                }
            }
            lumas[q] = sum / total;
        }
        c[3] = 0.5f * ((lumas[1] - lumas[0]) + (lumas[3] - lumas[2]));
        c[4] = 0.5f * ((lumas[2] - lumas[0]) + (lumas[3] - lumas[1]));
        c[5] = 0.25f * ((lumas[0] + lumas[1]) + (lumas[2] + lumas[3])) - own;
    });
}

static Image frame(const FrameInputs &in, const Weights &weights) {
    const Image depth = some_channels(in.gbuffer, 3, 1);
    Image motion = in.motions[0];  // over `reached` frames: the three chains share their beginning
    int reached = 1;
    std::vector<Image> frames;  // oldest first
    std::vector<Warp> warps;
    Image color(0, 0, 0), mask(0, 0, 0);
    for (size_t i = 0; i < 3; ++i) {
        const int step = in.steps[i];
        for (; reached < step; ++reached) motion = chain_step(motion, in.motions[reached]);
        Image warped = in.colors[i], instead = warped;  // step 0: the frame itself, to be trusted everywhere
        Mask valid(depth.height, depth.width, 1, 1);
        if (step > 0) {
            warped = warp(in.colors[i], motion).first;
            valid = holes(motion, in.surfaces[i + 1], in.surfaces[0], in.nov, depth, weights.test);
            if (i == 0 && weights.reshades)
                instead = reshade(in.colors[0], warped, motion, valid, in.surfaces[1], in.surfaces[0], some_channels(in.gbuffer, 6, 3));
            else if (i == 0)
                instead = occlusion_warp(in.colors[0], warped, motion, depth, valid).second;
        }
        // A step equal to the one before it stands for a frame that is missing: still warped, but nothing of it is trusted.
        const bool missing = i > 0 && step == in.steps[i - 1];
        Image trust(depth.height, depth.width, 1);
        if (!missing) std::copy(valid.data.begin(), valid.data.end(), trust.data.begin());
        warped = relu(std::move(warped));  // colours below 0 become 0
        if (i == 0) {
            instead = relu(std::move(instead));
            color = concat({&instead, &warped});
            mask = trust;
        }
        if (step > 0 && !missing && weights.detail) warps.push_back({&in.colors[i], motion, &in.surfaces[i + 1].stencil});
        frames.insert(frames.begin(), concat({&warped, &trust}));
    }
    if (weights.detail) show_detail(warps, in.surfaces[0].stencil, color);
    seen("color", color);
    seen("mask", mask);
    for (const Image &x : frames) seen("history", x);
    return network(color, in.gbuffer, mask, frames, weights);
}

// ---- Files ----

static std::string read_file(const fs::path &path) {
    if (!fs::is_regular_file(path)) refuse(path, fs::exists(path) ? "not a file" : "missing");
    std::string bytes(fs::file_size(path), '\0');
    if (!std::ifstream(path, std::ios::binary).read(bytes.data(), std::streamsize(bytes.size()))) refuse(path, "cannot be read");
    return bytes;
}

// Numbers of a little-endian file; this machine is taken to be little-endian itself.
template <typename T>
static std::vector<T> numbers_from(std::string_view bytes) {
    std::vector<T> numbers(bytes.size() / sizeof(T));
    if (!numbers.empty()) std::memcpy(numbers.data(), bytes.data(), numbers.size() * sizeof(T));
    return numbers;
}

static bool all_finite(const std::vector<float> &numbers) {
    return std::all_of(numbers.begin(), numbers.end(), [](float value) { return std::isfinite(value); });
}

using Shape = std::vector<size_t>;

static std::string text_of(const Shape &shape) {
    std::string text;
    for (const size_t n : shape) text += (text.empty() ? "" : ", ") + std::to_string(n);
    return "(" + text + (shape.size() == 1 ? ",)" : ")");
}

// Whether the size of an array is exactly `bytes`. A file may claim any sizes: their product must not overflow.
static bool fills(const Shape &shape, size_t item, size_t bytes) {
    size_t needed = item;
    for (const size_t n : shape) {
        if (n == 0 || needed > bytes / n) return false;
        needed *= n;
    }
    return needed == bytes;
}

// A cursor over names, whole numbers and brackets: enough for a .npy header, which is Python, and for safetensors' JSON.
class Text {
public:
    Text(fs::path path, std::string_view text) : path_(std::move(path)), text_(text) {}

    std::string word() {  // a name in quotes, a number, True or False
        const char quote = take('\'') ? '\'' : take('"') ? '"' : '\0';
        std::string value;
        for (; next_ < text_.size(); ++next_) {
            if (quote ? text_[next_] == quote : !std::isalnum((unsigned char)text_[next_])) break;
            if (text_[next_] == '\\' && next_ + 1 < text_.size()) ++next_;  // no escapes in the names that matter
            value += text_[next_];
        }
        if (quote) expect(quote);
        return value;
    }
    // Calls `item` at each item between two brackets; commas separate them, and one may follow the last.
    template <typename Item>
    void items(const char *brackets, Item item) {
        expect(brackets[0]);
        while (!take(brackets[1])) {
            item();
            if (take(',')) continue;
            expect(brackets[1]);
            break;
        }
    }
    template <typename Value>
    void entries(Value value) {  // of a dictionary: calls `value` with each key, at its value
        items("{}", [&] {
            const std::string key = word();
            expect(':');
            value(key);
        });
    }
    Shape sizes(const char *brackets) {
        Shape sizes;
        items(brackets, [&] {
            const std::string digits = word();
            if (digits.empty() || digits.size() > 15 || digits.find_first_not_of("0123456789") != std::string::npos)
                refuse(path_, "damaged header: not a whole number before its byte " + std::to_string(next_));
            sizes.push_back(std::stoull(digits));
        });
        return sizes;
    }

private:
    bool take(char wanted) {
        next_ = std::min(text_.find_first_not_of(" \t\r\n", next_), text_.size());
        const bool there = next_ < text_.size() && text_[next_] == wanted;
        next_ += there;
        return there;
    }
    void expect(char wanted) {
        if (!take(wanted)) refuse(path_, std::string("damaged header: no ") + wanted + " at its byte " + std::to_string(next_));
    }
    fs::path path_;
    std::string_view text_;
    size_t next_ = 0;
};

template <typename T> constexpr const char *DESCR = "<f4";
template <> constexpr const char *DESCR<uint8_t> = "|u1";
template <> constexpr const char *DESCR<int32_t> = "<i4";

// Shape and numbers of a .npy file of version 1.0 or 2.0.
template <typename T>
static std::pair<Shape, std::vector<T>> read_npy(const fs::path &path) {
    const std::string bytes = read_file(path);
    if (bytes.size() < 12 || bytes.compare(0, 6, "\x93NUMPY") != 0) refuse(path, "not a .npy file, or truncated");
    if ((bytes[6] != 1 && bytes[6] != 2) || bytes[7] != 0) refuse(path, "expected version 1.0 or 2.0 of the .npy format");
    const std::string_view rest = std::string_view(bytes).substr(bytes[6] == 1 ? 10 : 12);
    const size_t length = bytes[6] == 1 ? numbers_from<uint16_t>({&bytes[8], 2})[0] : numbers_from<uint32_t>({&bytes[8], 4})[0];
    if (length > rest.size()) refuse(path, "truncated in its header");
    const std::string_view data = rest.substr(length);

    std::string descr, fortran;
    Shape shape;
    Text text(path, rest.substr(0, length));
    text.entries([&](const std::string &key) {
        if (key == "shape") shape = text.sizes("()");
        else (key == "descr" ? descr : fortran) = text.word();
    });
    if (descr != DESCR<T>) refuse(path, std::string("expected numbers of kind ") + DESCR<T> + ", got '" + descr + "'");
    if (fortran != "False") refuse(path, "expected C order, with fortran_order False");
    if (!fills(shape, sizeof(T), data.size()))
        refuse(path, "its " + std::to_string(data.size()) + " bytes of numbers are not an array of shape " + text_of(shape));
    return {shape, numbers_from<T>(data)};
}

template <typename T>
static void write_npy(const fs::path &path, const Shape &shape, const std::vector<T> &numbers) {
    std::string header = std::string("{'descr': '") + DESCR<T> + "', 'fortran_order': False, 'shape': " + text_of(shape) + ", }";
    header.append(63 - (10 + header.size()) % 64, ' ').append("\n");  // the numbers begin at a multiple of 64
    std::ofstream file(path, std::ios::binary);
    file.write("\x93NUMPY\x01", 8).put(char(header.size() % 256)).put(char(header.size() / 256)) << header;
    file.write(reinterpret_cast<const char *>(numbers.data()), std::streamsize(numbers.size() * sizeof(T))).flush();
    if (!file) refuse(path, "cannot be written");
}

struct Tensor {
    Shape shape;
    std::vector<float> numbers;
};

// A safetensors file: the length of a JSON header, the header, the numbers. Their order is not fixed: we go by the names.
static std::map<std::string, Tensor> read_safetensors(const fs::path &path, const std::string &bytes,
                                                      std::map<std::string, std::string> &metadata) {
    const uint64_t length = bytes.size() < 8 ? UINT64_MAX : numbers_from<uint64_t>({bytes.data(), 8})[0];
    if (bytes.size() < 8 || length > bytes.size() - 8) refuse(path, "not a safetensors file, or truncated");
    const std::string_view header = std::string_view(bytes).substr(8, length), data = std::string_view(bytes).substr(8 + length);
    std::map<std::string, Tensor> tensors;
    Text text(path, header);
    text.entries([&](const std::string &name) {
        std::string dtype;
        Shape shape, at;
        text.entries([&](const std::string &key) {
            if (key == "shape") shape = text.sizes("[]");
            else if (key == "data_offsets") at = text.sizes("[]");
            else dtype = text.word();  // or, in __metadata__, any text
            if (name == "__metadata__") metadata[key] = dtype;
        });
        if (name == "__metadata__") return;
        if (dtype != "F32") refuse(path, name + ": expected dtype F32, got " + dtype);
        if (at.size() != 2 || at[0] > at[1] || at[1] > data.size() || !fills(shape, sizeof(float), at[1] - at[0]))
            refuse(path, name + ": its data_offsets do not go with its shape, or lie outside the file");
        tensors[name] = {shape, numbers_from<float>(data.substr(at[0], at[1] - at[0]))};
        if (!all_finite(tensors[name].numbers)) refuse(path, name + ": not all of it is finite");
    });
    return tensors;
}

// The same weights come with many cases: they are read again only where the bytes are not those of the case before.
static const Weights &read_weights(const fs::path &path) {
    static std::string last;
    static Weights weights;
    std::string bytes = read_file(path);
    if (bytes == last) return weights;
    last.clear();
    weights = {path, {}, false, HoleTest::footprint, false};
    std::map<std::string, std::string> metadata;
    const std::map<std::string, Tensor> tensors = read_safetensors(path, bytes, metadata);
    // Version 1 has none of the three entries, versions 3 and 4 have two, version 5 has all.
    const std::string version = metadata["stss_weights_version"];
    if (version != "1" && version != "3" && version != "4" && version != "5")
        refuse(path, "expected stss_weights_version 1, 3, 4 or 5, got " + version);
    for (const char *entry : {"second_color", "hole_test", "hole_fill"})
        if ((version == "1" || (entry == std::string("hole_fill") && version != "5")) && metadata.count(entry))
            refuse(path, std::string(entry) + ": expected no such entry in version " + version);
    const std::string fill = version == "5" ? metadata["hole_fill"] : "occlusion_warp";
    if (fill != "occlusion_warp" && fill != "reshade") refuse(path, "hole_fill: expected occlusion_warp or reshade, got " + fill);
    weights.reshades = fill == "reshade";
    const std::string second_color = version == "1" ? "newest" : metadata["second_color"];
    const std::string test = version == "1" ? "footprint" : metadata["hole_test"];
    if (test != "footprint" && test != "paper") refuse(path, "hole_test: expected footprint or paper, got " + test);
    weights.test = test == "paper" ? HoleTest::paper : HoleTest::footprint;
    weights.detail = version >= "4" && second_color == "detail";
    if (!weights.detail && second_color != "newest")
        refuse(path, std::string("second_color: expected newest") + (version >= "4" ? " or detail" : "") + ", got " + second_color);
    for (const auto &[name, weight] : tensors) {
        if (weight.shape.size() == 1) continue;  // a bias
        const std::string layer = name.substr(0, name.rfind('.'));
        const auto bias = tensors.find(layer + ".bias");
        if (weight.shape.size() != 4 || weight.shape[2] != weight.shape[3] || weight.shape[2] % 2 == 0)
            refuse(path, name + ": expected shape (O, I, k, k), got " + text_of(weight.shape));
        if (bias == tensors.end() || bias->second.shape != Shape{weight.shape[0]})
            refuse(path, layer + ".bias: missing, or not of shape " + text_of({weight.shape[0]}));
        weights.layers.emplace(layer, Layer(weight.numbers, bias->second.numbers, weight.shape[1], weight.shape[2]));
    }
    last = std::move(bytes);
    return weights;
}

// ---- A case: its inputs, checked against the table of docs/ports.md, and its outputs ----

class Case {
public:
    explicit Case(fs::path folder) : folder_(std::move(folder)) {}

    fs::path path(const std::string &name) const { return folder_ / "in" / (name + ".npy"); }
    const Weights &weights() const { return read_weights(folder_ / "in" / "weights.safetensors"); }

    // `spec` is the shape as the table writes it: a letter gets its size from the first array that has it. One with a factor in front
    // (2H) comes behind such an array.
    // Then "finite" where the reference refuses NaN and infinity; motion and position may hold them.
    template <typename T>
    std::pair<Shape, std::vector<T>> array(const std::string &name, const std::string &spec) {
        auto [shape, numbers] = read_npy<T>(path(name));
        std::istringstream words(spec);
        size_t axis = 0;
        bool fits = true, finite = false;
        for (std::string word; words >> word && !(finite = word == "finite"); ++axis) {
            const bool letter = std::isalpha((unsigned char)word[0]), multiple = word.size() > 1 && std::isalpha((unsigned char)word[1]);
            const size_t over = letter && word.size() > 1 ? word[2] - '0' : 1;  // H/8
            fits = fits && axis < shape.size() && shape[axis] < (1 << 20);      // far below the limits of an int and of a float's 24 bits
            if (!fits) continue;
            const size_t size = shape[axis] * over;
            fits = size == (letter ? sizes_.emplace(word[0], size).first->second : std::stoul(word) * (multiple ? sizes_.at(word[1]) : 1));
        }
        if (!fits || axis != shape.size()) {
            std::string known;
            for (const auto &[letter, size] : sizes_) known += std::string(", ") + letter + " = " + std::to_string(size);
            refuse(path(name), "expected shape (" + spec + ")" + known + "; got " + text_of(shape));
        }
        if constexpr (std::is_same_v<T, float>)
            if (finite && !all_finite(numbers)) refuse(path(name), "not all of it is finite");
        return {shape, numbers};
    }
    Image image(const std::string &name, const std::string &spec) { return grids<float>(name, spec, 0)[0]; }
    std::vector<Image> images(const std::string &name, const std::string &spec) { return grids<float>(name, spec, 1); }
    Mask mask(const std::string &name) {
        const Mask mask = grids<uint8_t>(name, "H W", 0)[0];
        if (*std::max_element(mask.data.begin(), mask.data.end()) > 1) refuse(path(name), "expected 0 and 1");
        return mask;
    }
    void require_multiples_of_8(const std::string &name) {
        if (sizes_['H'] % 8 != 0 || sizes_['W'] % 8 != 0) refuse(path(name), "expected H and W to be multiples of 8");
    }
    template <typename T>
    void write(const std::string &name, const Grid<T> &grid) const {
        Shape shape{size_t(grid.height), size_t(grid.width)};
        if (std::is_same_v<T, float>) shape.push_back(grid.channels);  // a mask has no axis of channels
        fs::create_directory(folder_ / "out");
        write_npy(folder_ / "out" / (name + ".npy"), shape, grid.data);
    }

private:
    // One grid, whose rows are the array's axis 0; or one for each step along that, its rows being axis 1.
    template <typename T>
    std::vector<Grid<T>> grids(const std::string &name, const std::string &spec, size_t rows) {
        const auto [shape, numbers] = array<T>(name, spec);
        const Grid<T> empty(int(shape[rows]), int(shape[rows + 1]), shape.size() > rows + 2 ? int(shape[rows + 2]) : 1);
        std::vector<Grid<T>> result(rows == 0 ? 1 : shape[0], empty);
        for (size_t i = 0; i < result.size(); ++i)
            std::copy_n(numbers.data() + i * empty.data.size(), empty.data.size(), result[i].data.data());
        return result;
    }
    fs::path folder_;
    std::map<char, size_t> sizes_;
};

static void run_motion_chain(Case &c) { c.write("motion", motion_chain(c.images("motions", "k H W 2"))); }

static void run_warp(Case &c) {
    const Image color = c.image("color", "H W C finite");
    const auto [warped, inside] = warp(color, c.image("motion", "H W 2"));
    c.write("warped", warped);
    c.write("inside", inside);
}

static void run_holes(Case &c) {
    const Image motion = c.image("motion", "H W 2");
    const auto surface = [&](const std::string &of) {
        return Surface{c.image("stencil" + of, "H W"), c.image("normal" + of, "H W 3"), c.image("position" + of, "H W 3")};
    };
    const HoleTest test = c.array<int32_t>("paper", "1").second[0] ? HoleTest::paper : HoleTest::footprint;
    c.write("valid", holes(motion, surface("_previous"), surface(""), c.image("nov", "H W"), c.image("depth", "H W"), test));
}

static void run_occlusion_warp(Case &c) {
    const Image color = c.image("color", "H W 3 finite"), warped = c.image("warped", "H W 3");
    const Image motion = c.image("motion", "H W 2"), depth = c.image("depth", "H W finite");
    const auto [occlusion_motion, filled] = occlusion_warp(color, warped, motion, depth, c.mask("valid"));
    c.write("occlusion_motion", occlusion_motion);
    c.write("occlusion_warp", filled);
}

static void run_reshade(Case &c) {
    const Image color = c.image("color", "H W 3 finite"), warped = c.image("warped", "H W 3 finite"), motion = c.image("motion", "H W 2");
    const Mask valid = c.mask("valid");
    const auto surface = [&](const std::string &of) {
        return Surface{c.image("stencil" + of, "H W finite"), c.image("normal" + of, "H W 3 finite"), c.image("position" + of, "H W 3")};
    };
    c.write("reshade", reshade(color, warped, motion, valid, surface("_previous"), surface(""), c.image("base_color", "H W 3 finite")));
}

static void run_rrm(Case &c) {
    const Mask valid = c.mask("valid");
    const std::vector<int32_t> r = c.array<int32_t>("rectangle", "4").second;
    if (*std::min_element(r.begin(), r.end()) < 0 || r[0] > valid.height - r[2] || r[1] > valid.width - r[3])
        refuse(c.path("rectangle"), "expected y, x, height, width within the mask");
    c.write("valid", rrm(valid, r));
}

static void run_history(Case &c) {
    const std::vector<Image> frames = c.images("history", "3 H W 4");
    c.require_multiples_of_8("history");
    c.write("feature", history(frames, c.weights()));
}

static void run_encoder(Case &c) {
    const Image color = c.image("color", "H W 6"), gbuffer = c.image("gbuffer", "H W 9"), mask = c.image("mask", "H W");
    c.require_multiples_of_8("color");
    const auto x = encoder(color, gbuffer, mask, c.weights());
    for (int i = 0; i < 4; ++i) c.write("x" + std::to_string(i + 1), x[i]);
}

static void run_erm(Case &c) {
    const Image x4 = c.image("x4", "H/8 W/8 32");
    c.write("reshaded", erm(x4, c.image("gbuffer", "H W 9"), c.image("mask", "H W"), c.weights()));
}

static void run_decoder(Case &c) {
    const Image reshaded = c.image("reshaded", "H/8 W/8 64"), feature = c.image("feature", "H/8 W/8 32");
    const Image x1 = c.image("x1", "H W 24"), x2 = c.image("x2", "H/2 W/2 24"), x3 = c.image("x3", "H/4 W/4 32");
    c.write("image", decoder(reshaded, feature, x1, x2, x3, c.image("color", "H W 6"), c.weights()));
}

static void run_network(Case &c) {
    const Image color = c.image("color", "H W 6 finite"), gbuffer = c.image("gbuffer", "H W 9 finite");
    const Image mask = c.image("mask", "H W finite");
    c.write("image", network(color, gbuffer, mask, c.images("history", "3 H W 4 finite"), c.weights()));
}

static void run_frame(Case &c) {
    FrameInputs in{c.images("colors", "3 H W 3 finite"), c.array<int32_t>("steps", "3").second, c.images("motions", "k H W 2"),
                   c.image("gbuffer", "H W 9 finite"), c.image("nov", "H W finite"), {}};
    if (in.steps[0] < 0 || !std::is_sorted(in.steps.begin(), in.steps.end()) || size_t(in.steps[2]) > in.motions.size())
        refuse(c.path("steps"), "expected three numbers from 0 on, not decreasing, no more than there are motions");
    const auto stencils = c.images("stencils", "4 H W finite"), normals = c.images("normals", "4 H W 3 finite");
    const auto positions = c.images("positions", "4 H W 3");
    for (int i = 0; i < 4; ++i) in.surfaces.push_back({stencils[i], normals[i], positions[i]});
    c.write("image", frame(in, c.weights()));
}

static void run_accumulate(Case &c) {
    const auto motions = c.images("motions", "k H W 2");
    const Image image = c.image("image", "2H 2W 3 finite");
    c.write("shown", accumulate(image, c.images("earlier", "k 2H 2W 3 finite"), motions));
}

static const std::map<std::string, void (*)(Case &)> STAGES = {
    {"motion_chain", run_motion_chain}, {"warp", run_warp}, {"holes", run_holes}, {"occlusion_warp", run_occlusion_warp},
    {"reshade", run_reshade}, {"rrm", run_rrm}, {"history", run_history}, {"encoder", run_encoder}, {"erm", run_erm},
    {"decoder", run_decoder}, {"network", run_network}, {"frame", run_frame},
    {"accumulate", run_accumulate},
};

// ---- The job ----

static void write_layer(const fs::path &path, const std::vector<Image> &images) {
    Shape shape{size_t(images[0].height), size_t(images[0].width)};
    if (images[0].channels > 1) shape.push_back(images[0].channels);
    if (images.size() > 1) shape.insert(shape.begin(), images.size());
    std::vector<float> numbers;
    for (const Image &image : images) numbers.insert(numbers.end(), image.data.begin(), image.data.end());
    write_npy(path, shape, numbers);
}

static void run_case(const fs::path &folder) {
    std::string stage = read_file(folder / "stage");
    stage.erase(stage.find_last_not_of(" \t\r\n") + 1);
    if (stage.empty() || stage.find_first_not_of("abcdefghijklmnopqrstuvwxyz0123456789_") != std::string::npos)
        refuse(folder / "stage", "expected one line, the name of a stage");
    Case job(folder);
    const auto found = STAGES.find(stage);
    // A stage of a later version is no error.
    if (found == STAGES.end()) {
        if (!std::ofstream(folder / "unsupported")) refuse(folder / "unsupported", "cannot be written");
        return;
    }
    std::map<std::string, std::vector<Image>> layers;
    layers_asked = fs::is_directory(folder / "layers") ? &layers : nullptr;
    found->second(job);
    for (const auto &[name, images] : layers) write_layer(folder / "layers" / (name + ".npy"), images);
}

static void run_job(const fs::path &job) {
    if (!fs::is_directory(job)) refuse(job, "no such folder");
    std::map<unsigned long, fs::path> cases;  // in the order of their numbers
    for (const auto &entry : fs::directory_iterator(job)) {
        const std::string name = entry.path().filename().string();
        const bool number = name.size() >= 4 && name.size() <= 9 && name.find_first_not_of("0123456789") == std::string::npos;
        if (number && entry.is_directory()) cases[std::stoul(name)] = entry.path();
    }
    if (cases.empty()) refuse(job, "no case in it; the first is a folder named 0000");
    for (const auto &[number, folder] : cases) run_case(folder);
}

int main(int argc, char **argv) {
    try {
        if (argc != 2) throw std::runtime_error("usage: port JOB, or port --serve");
        if (std::string(argv[1]) == "--serve") {
            std::cout << "stss serve 1" << std::endl;
            for (std::string job; std::getline(std::cin, job); std::cout << "done " << job << std::endl) run_job(job);
        } else {
            run_job(argv[1]);
        }
        return 0;
    } catch (const std::exception &error) {
        std::string line = error.what();
        for (char &c : line) c = std::iscntrl((unsigned char)c) ? ' ' : c;  // one line, whatever a file has for a name
        std::fprintf(stderr, "%s\n", line.c_str());
        return 2;
    }
}
