// SPDX-License-Identifier: MIT
// Stage occlusion_warp (docs/stages.md). The splat's winner is the smallest (depth, raster index): in two passes, since WGSL has no
// atomics of 64 bits. Both are kept inverted, for atomicMax: a new buffer is 0, which then says that nothing was written.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> motion: array<vec2<f32>>;
@group(0) @binding(2) var<storage, read> depth: array<f32>;
@group(0) @binding(3) var<storage, read_write> nearest: array<atomic<u32>>;
@group(0) @binding(4) var<storage, read_write> winner: array<atomic<u32>>;
@group(0) @binding(5) var<storage, read_write> occlusion_motion: array<vec2<f32>>;

const FARTHEST = 0x41200000u;  // the bits of 10.0; those of numbers >= 0 sort as integers

fn splat(p: vec2<i32>, second_pass: bool) {
    if (p.x >= frame.width || p.y >= frame.height) { return; }
    let index = p.y * frame.width + p.x;
    let bits = bitcast<u32>(depth[index]);
    let near = select(bits, 0u, bits == 0x80000000u);  // -0
    let place = lead(p, motion[index], frame);
    if (!place.finite || near >= FARTHEST) { return; }
    for (var tap = 0; tap < 4; tap++) {
        let q = place.at + vec2<i32>(tap & 1, tap >> 1);
        if (any(q < vec2<i32>(0)) || q.x >= frame.width || q.y >= frame.height) { continue; }
        let there = q.y * frame.width + q.x;
        if (!second_pass) {
            atomicMax(&nearest[there], ~near);
        } else if (atomicLoad(&nearest[there]) == ~near) {
            atomicMax(&winner[there], ~u32(index));
        }
    }
}

@compute @workgroup_size(8, 8)
fn splat_depth(@builtin(global_invocation_id) id: vec3<u32>) { splat(vec2<i32>(id.xy), false); }

@compute @workgroup_size(8, 8)
fn splat_index(@builtin(global_invocation_id) id: vec3<u32>) { splat(vec2<i32>(id.xy), true); }

// The motion found there; warp.wgsl then reads the colour along it.
@compute @workgroup_size(8, 8)
fn lookup(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= frame.width || p.y >= frame.height) { return; }
    let index = p.y * frame.width + p.x;
    let taps = follow(p, motion[index], frame);
    let won = atomicLoad(&winner[taps.y0 * frame.width + taps.x0]);
    if (won != 0u) { occlusion_motion[index] = motion[~won]; }
}
