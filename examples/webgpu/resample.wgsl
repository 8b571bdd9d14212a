// SPDX-License-Identifier: MIT
// All copies: changes of size (docs/stages.md, resample), and inputs put side by side. A concatenation is several such copies.

struct Copy {
    width: i32, height: i32, channels: i32,                // of the input
    columns: i32, rows: i32, pitch: i32, first: i32,       // of the output, and the first of its channels that is written
    size: i32,                                             // COPIED and so on
    positive: i32,                                         // 1: numbers below 0 become 0
    masked: i32,                                           // 1: multiplied by the mask; 2: written only where the mask is not 0
}
const COPIED = 0;    // the last row and column repeated, or cropped
const CORNERS = 1;   // twice the size, corner pixels aligned
const CENTRES = 2;   // twice the size, pixel centres aligned
const EIGHTH = 3;    // the mean of pixels 8i + 3 and 8i + 4

@group(0) @binding(0) var<uniform> sizes: Copy;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read> mask: array<f32>;
@group(0) @binding(3) var<storage, read_write> y: array<f32>;

struct Along { low: i32, high: i32, t: f32 }

fn along(o: i32, n: i32) -> Along {
    if (sizes.size == EIGHTH) { return Along(8 * o + 3, 8 * o + 4, 0.5); }
    if (sizes.size == CENTRES) { return Along(max((o - 1) >> 1u, 0), min(((o - 1) >> 1u) + 1, n - 1), select(0.75, 0.25, o % 2 == 1)); }
    if (sizes.size == COPIED) { return Along(min(o, n - 1), min(o, n - 1), 0.0); }
    // Output o of 2n reads o (n - 1) / (2n - 1): the whole part and the rest by integers, which no device rounds.
    let low = o * (n - 1) / (2 * n - 1);
    return Along(low, min(low + 1, n - 1), f32(o * (n - 1) % (2 * n - 1)) / f32(2 * n - 1));
}

fn x_at(row: i32, column: i32, channel: i32) -> f32 {
    return x[(row * sizes.width + column) * sizes.channels + channel];
}

@compute @workgroup_size(8, 8)
fn copy(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    let c = i32(id.z);
    if (p.x >= sizes.columns || p.y >= sizes.rows) { return; }
    let column = along(p.x, sizes.width);
    let row = along(p.y, sizes.height);
    let left = x_at(row.low, column.low, c) + (x_at(row.high, column.low, c) - x_at(row.low, column.low, c)) * row.t;
    let right = x_at(row.low, column.high, c) + (x_at(row.high, column.high, c) - x_at(row.low, column.high, c)) * row.t;
    var found = left + (right - left) * column.t;
    let pixel = p.y * sizes.columns + p.x;
    if (sizes.positive != 0) { found = max(found, 0.0); }
    if (sizes.masked == 1) { found *= mask[pixel]; }
    if (sizes.masked != 2 || mask[pixel] != 0.0) { y[pixel * sizes.pitch + sizes.first + c] = found; }
}

// 12 channels at (y, x) are added to 3 channels of 2 x 2 pixels: the end of the decoder.
@compute @workgroup_size(8, 8)
fn shuffle(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= sizes.columns || p.y >= sizes.rows) { return; }
    y[(p.y * sizes.columns + p.x) * 3 + i32(id.z)] += x_at(p.y / 2, p.x / 2, 4 * i32(id.z) + 2 * (p.y % 2) + p.x % 2);
}
