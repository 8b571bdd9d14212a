// SPDX-License-Identifier: MIT
// Stage rrm (docs/stages.md): a rectangle of the mask becomes a hole.

struct Hole { width: i32, height: i32, y: i32, x: i32, h: i32, w: i32 }

@group(0) @binding(0) var<uniform> hole: Hole;
@group(0) @binding(1) var<storage, read> valid: array<f32>;
@group(0) @binding(2) var<storage, read_write> masked: array<f32>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= hole.width || p.y >= hole.height) { return; }
    let in_hole = p.y >= hole.y && p.y < hole.y + hole.h && p.x >= hole.x && p.x < hole.x + hole.w;
    masked[p.y * hole.width + p.x] = select(valid[p.y * hole.width + p.x], 0.0, in_hole);
}
