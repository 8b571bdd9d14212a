// SPDX-License-Identifier: MIT
// Stage motion_chain (docs/stages.md), one frame further back: m_{j+1}(p) = m_j(p) + the longest of four motions there, 0 if one is 0.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> chained: array<vec2<f32>>;
@group(0) @binding(2) var<storage, read> earlier: array<vec2<f32>>;
@group(0) @binding(3) var<storage, read_write> longer: array<vec2<f32>>;

const LONGEST = 3.4028234e38;  // of a motion that is not finite, or whose square is not

fn earlier_at(q: vec2<i32>) -> vec2<f32> {
    if (any(q < vec2<i32>(0)) || q.x >= frame.width || q.y >= frame.height) { return vec2<f32>(0.0); }
    return earlier[q.y * frame.width + q.x];
}

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= frame.width || p.y >= frame.height) { return; }

    let index = p.y * frame.width + p.x;
    let place = lead(p, chained[index], frame);
    // trunc, not floor: between -1 and 0 the corner is 0.
    let corner = select(place.at, vec2<i32>(0), (place.at == vec2<i32>(-1)) & (place.fraction > vec2<f32>(0.0)));
    var longest = vec2<f32>(0.0);
    var length = -1.0;
    var still = false;
    for (var tap = 0; tap < 4; tap++) {
        let m = earlier_at(corner + vec2<i32>(tap & 1, tap >> 1));
        // By its bits: a device may take numbers below 1.2e-38 for 0.
        still |= all((bitcast<vec2<u32>>(m) & vec2<u32>(0x7fffffffu)) == vec2<u32>(0u));
        let squared = m.x * m.x + m.y * m.y;
        let this_length = select(LONGEST, squared, is_finite(squared));
        if (this_length > length) { longest = m; length = this_length; }  // the first of equals stays
    }
    if (still || !place.finite) { longest = vec2<f32>(0.0); }
    longer[index] = chained[index] + longest;
}
