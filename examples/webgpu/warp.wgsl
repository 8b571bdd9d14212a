// SPDX-License-Identifier: MIT
// Stage warp (docs/stages.md): warped(p) = color read bilinearly at p + motion(p); inside: whether that lies in the frame.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> color: array<f32>;  // H W C, as the .npy file has it
@group(0) @binding(2) var<storage, read> motion: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read_write> warped: array<f32>;
@group(0) @binding(4) var<storage, read_write> inside: array<f32>;

fn color_at(x: i32, y: i32, channel: i32) -> f32 {
    return color[(y * frame.width + x) * frame.channels + channel];
}

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= frame.width || p.y >= frame.height) { return; }  // the last work-groups reach beyond the frame

    let index = p.y * frame.width + p.x;
    let taps = follow(p, motion[index], frame);
    inside[index] = f32(taps.inside);
    for (var c = 0; c < frame.channels; c++) {
        warped[index * frame.channels + c] = between(
            color_at(taps.x0, taps.y0, c), color_at(taps.x1, taps.y0, c),
            color_at(taps.x0, taps.y1, c), color_at(taps.x1, taps.y1, c), taps);
    }
}
