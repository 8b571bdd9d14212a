// SPDX-License-Identifier: MIT
// The second colour "detail" (docs/stages.md): differences within a pixel, as warped frames show them. Vectors of four are its quarters:
// upper left, upper right, lower left, lower right.

struct Quarters { sums: vec4<f32>, totals: vec4<f32> }

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> color: array<f32>;  // H W 3: of a frame that is warped; in show_detail the network's first colour
@group(0) @binding(2) var<storage, read> motion: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read> numbers: array<vec2<f32>>;  // of objects: in that frame, and now
@group(0) @binding(4) var<storage, read_write> quarters: array<Quarters>;
@group(0) @binding(5) var<storage, read_write> second: array<f32>;  // H W 3

fn luma_at(x: i32, y: i32) -> f32 {
    let at = (y * frame.width + x) * 3;
    return 0.299 * color[at] + 0.587 * color[at + 1] + 0.114 * color[at + 2];
}

// 1 where a sample shows the pixel's own object, else 0.
fn is_same(x: i32, y: i32, index: i32) -> f32 {
    return f32(numbers[y * frame.width + x].x == numbers[index].y);
}

fn tent(distance: vec4<f32>) -> vec4<f32> {
    return max(vec4<f32>(0.0), 1.0 - 2.0 * abs(distance));
}

// Adds the samples of one frame: each that shows the same object counts at the quarters whose middles are within half a pixel.
@compute @workgroup_size(8, 8)
fn add_samples(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= frame.width || p.y >= frame.height) { return; }
    let index = p.y * frame.width + p.x;
    let taps = follow(p, motion[index], frame);
    if (!taps.inside) { return; }
    let right = taps.fx + vec4<f32>(-0.25, 0.25, -0.25, 0.25);
    let down = taps.fy + vec4<f32>(-0.25, -0.25, 0.25, 0.25);
    let nw = tent(right) * tent(down) * is_same(taps.x0, taps.y0, index);
    let ne = tent(right - 1.0) * tent(down) * is_same(taps.x1, taps.y0, index);
    let sw = tent(right) * tent(down - 1.0) * is_same(taps.x0, taps.y1, index);
    let se = tent(right - 1.0) * tent(down - 1.0) * is_same(taps.x1, taps.y1, index);
    quarters[index].sums += nw * luma_at(taps.x0, taps.y0) + ne * luma_at(taps.x1, taps.y0)
        + sw * luma_at(taps.x0, taps.y1) + se * luma_at(taps.x1, taps.y1);
    quarters[index].totals += nw + ne + sw + se;
}

// Half the difference of the right and the left quarters; that of the lower and the upper; the mean of all less the first colour.
@compute @workgroup_size(8, 8)
fn show_detail(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= frame.width || p.y >= frame.height) { return; }
    let index = p.y * frame.width + p.x;
    let own = luma_at(p.x, p.y);
    let l = (0.25 * own + quarters[index].sums) / (0.25 + quarters[index].totals);
    second[3 * index] = 0.5 * ((l.y - l.x) + (l.w - l.z));
    second[3 * index + 1] = 0.5 * ((l.z - l.x) + (l.w - l.y));
    second[3 * index + 2] = 0.25 * ((l.x + l.y) + (l.z + l.w)) - own;
}
