// SPDX-License-Identifier: MIT
// Stage holes (docs/stages.md): 0 where the warped colour shows another surface than the one seen now.
// Nine inputs are more storage buffers than the eight that every device has: they come as a renderer's G-buffer would.

@group(0) @binding(1) var<storage, read> motion: array<vec2<f32>>;
@group(0) @binding(2) var<storage, read> earlier: array<Surface>;
@group(0) @binding(4) var<storage, read> view: array<vec2<f32>>;  // NoV, depth
@group(0) @binding(5) var<storage, read_write> valid: array<f32>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= frame.width || p.y >= frame.height) { return; }

    let index = p.y * frame.width + p.x;
    let here = now[index];
    let taps = follow(p, motion[index], frame);
    let a = earlier[taps.y0 * frame.width + taps.x0];
    let b = earlier[taps.y0 * frame.width + taps.x1];
    let c = earlier[taps.y1 * frame.width + taps.x0];
    let d = earlier[taps.y1 * frame.width + taps.x1];
    let stencil = between(a.stencil, b.stencil, c.stencil, d.stencil, taps);
    let normal = vec3<f32>(
        between(a.normal.x, b.normal.x, c.normal.x, d.normal.x, taps),
        between(a.normal.y, b.normal.y, c.normal.y, d.normal.y, taps),
        between(a.normal.z, b.normal.z, c.normal.z, d.normal.z, taps));

    // Static geometry: where the offset that is read, as the colour is, exceeds 1.5 footprints of this pixel.
    let oa = a.position - here.position; let ob = b.position - here.position;
    let oc = c.position - here.position; let od = d.position - here.position;
    let offset = vec3<f32>(
        between(oa.x, ob.x, oc.x, od.x, taps), between(oa.y, ob.y, oc.y, od.y, taps), between(oa.z, ob.z, oc.z, od.z, taps));
    var near = is_near(offset, 2.25 * squared_footprint(p));
    if (frame.choice != 0) {
        // The paper's test: the furthest of all four taps counts, those with weight 0 too.
        let facing = abs(view[index].x);
        let bias = 7.5 * facing + 45.0 * (1.0 - facing) + 50.0 * view[index].y;
        near = bias >= 0.0 && is_near(oa, bias * bias) && is_near(ob, bias * bias) && is_near(oc, bias * bias) && is_near(od, bias * bias);
    }

    // Turned away: by 60 degrees, or a moving surface by 11. The divisor is the length of the earlier normal alone. Two normals of 0 are no surface.
    let length = sqrt(normal.x * normal.x + normal.y * normal.y + normal.z * normal.z);
    let cosine = (here.normal.x * normal.x + here.normal.y * normal.y + here.normal.z * normal.z) / (length + 1e-5);
    let surface = any(normal != vec3<f32>(0.0)) || any(here.normal != vec3<f32>(0.0));
    let is_moving_hole = stencil != 0.0 && cosine < 0.98 && surface;
    let is_static_hole = stencil == 0.0 && (!near || (frame.choice == 0 && cosine < 0.5 && surface));

    let is_other_object = 3.0 * abs(stencil - here.stencil) > 1.0;
    valid[index] = f32(taps.inside && !is_static_hole && !is_moving_hole && !is_other_object);
}
