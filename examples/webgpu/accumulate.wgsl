// SPDX-License-Identifier: MIT
// Stage accumulate (docs/stages.md): an image mixed with those of the display frames before it, one in each pass, which adds to a sum.
// `frame` has the size of the display.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> image: array<f32>;    // H W 3
@group(0) @binding(2) var<storage, read> earlier: array<f32>;  // H W 3
@group(0) @binding(3) var<storage, read> motion: array<vec2<f32>>;  // half as many rows and columns
@group(0) @binding(4) var<storage, read_write> total: array<f32>;   // of how far earlier images lie from this one
@group(0) @binding(5) var<storage, read_write> shown: array<f32>;

fn earlier_at(x: i32, y: i32, channel: i32) -> f32 {
    return earlier[(y * frame.width + x) * frame.channels + channel];
}

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= frame.width || p.y >= frame.height) { return; }

    let index = p.y * frame.width + p.x;
    let moved = motion[(p.y / 2) * (frame.width / 2) + p.x / 2];
    let taps = follow(p, 2.0 * moved, frame);
    // Of the newer, of the older; less where a surface moves by more than 4 pixels.
    let share = select(0.25, 0.125, frame.choice != 0) * 16.0 / max(16.0, dot(moved, moved));
    let first = max(p - 1, vec2<i32>(0));
    let last = min(p + 1, vec2<i32>(frame.width, frame.height) - 1);
    for (var c = 0; c < frame.channels; c++) {
        let here = image[index * frame.channels + c];
        var low = here;
        var high = here;
        for (var y = first.y; y <= last.y; y++) {
            for (var x = first.x; x <= last.x; x++) {
                let near = image[(y * frame.width + x) * frame.channels + c];
                low = min(low, near);
                high = max(high, near);
            }
        }
        let there = clamp(between(
            earlier_at(taps.x0, taps.y0, c), earlier_at(taps.x1, taps.y0, c),
            earlier_at(taps.x0, taps.y1, c), earlier_at(taps.x1, taps.y1, c), taps), low, high);
        let sum = total[index * frame.channels + c] + select(0.0, (there - here) * share, taps.inside);
        total[index * frame.channels + c] = sum;
        shown[index * frame.channels + c] = here + sum;
    }
}
