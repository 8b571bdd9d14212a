// SPDX-License-Identifier: MIT
// Where a motion leads, and the four pixels around it: the beginning of every shader that follows one (WGSL has no #include).

// `choice`: of stage holes, the paper's test; of accumulate, the older image.
struct Frame { width: i32, height: i32, channels: i32, choice: i32 }

struct Taps {
    x0: i32, y0: i32, x1: i32, y1: i32,  // columns and rows, within the frame
    fx: f32, fy: f32,                    // from the first to the second, 0 to 1
    inside: bool,                        // whether the motion is finite and leads into the frame
}

// WGSL may assume that there is no NaN and no infinity, and remove x == x: look at the bits.
fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

struct Place {
    at: vec2<i32>,        // the whole pixel, perhaps outside the frame
    fraction: vec2<f32>,  // beyond it, 0 to 1
    finite: bool,
}

// Never p + m: far from the corner that sum has lost the bits of the fraction. A whole number of pixels is exact, and so is m - floor(m).
fn lead(p: vec2<i32>, m: vec2<f32>, frame: Frame) -> Place {
    let finite = is_finite(m.x) && is_finite(m.y);
    let moved = select(vec2<f32>(0.0), m, finite);
    let whole = floor(moved);
    // Clamp before it becomes an integer, which cannot hold 1e12. One pixel beyond the frame is as good as any distance.
    let limit = vec2<f32>(vec2<i32>(frame.width, frame.height) + 1);
    return Place(p + vec2<i32>(clamp(whole, -limit, limit)), moved - whole, finite);
}

// The same, clamped into the frame.
fn follow(p: vec2<i32>, m: vec2<f32>, frame: Frame) -> Taps {
    let place = lead(p, m, frame);
    let last = vec2<i32>(frame.width, frame.height) - 1;
    let inside = place.finite && all(place.at >= vec2<i32>(0)) && all(place.at + vec2<i32>(ceil(place.fraction)) <= last);

    // A place outside is clamped onto a pixel of the border; the last column and row have no neighbour.
    let fraction = select(place.fraction, vec2<f32>(0.0), (place.at < vec2<i32>(0)) | (place.at >= last));
    let first = clamp(place.at, vec2<i32>(0), last);
    let second = min(first + 1, last);
    return Taps(first.x, first.y, second.x, second.y, fraction.x, fraction.y, inside);
}

// Two levels of a + (b - a) t. Not mix(a, b, t), which is a (1 - t) + b t: there a flat image is not flat, and a stencil of 0 not 0.
fn between(a: f32, b: f32, c: f32, d: f32, taps: Taps) -> f32 {
    let top = a + (b - a) * taps.fx;
    let bottom = c + (d - c) * taps.fx;
    return top + (bottom - top) * taps.fy;
}
