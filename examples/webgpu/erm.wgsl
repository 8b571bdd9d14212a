// SPDX-License-Identifier: MIT
// Stage erm (docs/stages.md) without its convolutions: the light of 5 x 5 places, weighted by how alike their materials are.

struct Size { width: i32, height: i32 }

@group(0) @binding(0) var<uniform> size: Size;
@group(0) @binding(1) var<storage, read> keys: array<f32>;   // 32 channels
@group(0) @binding(2) var<storage, read> light: array<f32>;  // 64 channels
@group(0) @binding(3) var<storage, read> mask: array<f32>;
@group(0) @binding(4) var<storage, read_write> reshaded: array<f32>;

fn key_length(index: i32) -> f32 {
    var sum = 0.0;
    for (var c = 0; c < 32; c++) { sum += keys[index * 32 + c] * keys[index * 32 + c]; }
    return max(sqrt(sum), 1e-12);
}

@compute @workgroup_size(8, 8)
fn reshade(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= size.width || p.y >= size.height) { return; }
    let here = p.y * size.width + p.x;
    let length = key_length(here);
    var sums = array<f32, 64>();
    var total = 0.0;
    for (var d = 0; d < 25; d++) {
        let q = p + vec2<i32>(d % 5, d / 5) - 2;
        if (any(q < vec2<i32>(0)) || q.x >= size.width || q.y >= size.height) { continue; }
        let there = q.y * size.width + q.x;
        let other = key_length(there);
        var alike = 0.0;
        for (var c = 0; c < 32; c++) { alike += mask[there] * (keys[there * 32 + c] / other) * (keys[here * 32 + c] / length); }
        alike = max(alike, 0.0);
        total += alike;
        for (var c = 0; c < 64; c++) { sums[c] += alike * (light[there * 64 + c] * mask[there]); }
    }
    for (var c = 0; c < 64; c++) { reshaded[here * 64 + c] = sums[c] / max(total, 1e-6); }
}
