// SPDX-License-Identifier: MIT
// Stage reshade (docs/stages.md): the colour of holes. find_samples, find_lights and fill run one after the other, since
// each reads what the one before it found around a hole.

@group(0) @binding(1) var<storage, read> motion: array<vec2<f32>>;
@group(0) @binding(2) var<storage, read> earlier: array<Surface>;
@group(0) @binding(4) var<storage, read> color: array<f32>;       // H W 3: of the earlier frame
@group(0) @binding(5) var<storage, read> valid: array<f32>;
@group(0) @binding(6) var<storage, read> base_color: array<f32>;  // H W 3
@group(0) @binding(7) var<storage, read_write> samples: array<vec4<f32>>;  // of holes: the mean of their own samples, and their number
@group(0) @binding(8) var<storage, read_write> filled: array<f32>;  // H W 3: as warped, at least 0, to begin with
@group(0) @binding(9) var<storage, read_write> lights: array<vec4<f32>>;  // of holes: the light around, and 1 if there is one

const LIGHT_REACH = 2;  // pixels from a hole to the sides of the square of holes whose mean light it takes
const REACH = 2;  // places from a hole to the sides of a ring
const LARGEST_STEP = 32;  // pixels from place to place of the last ring; those before have 1, 2, 4, 8 and 16

fn is_none(normal: vec3<f32>) -> bool { return all(normal == vec3<f32>(0.0)); }

// Whether an earlier pixel shows the surface of pixel p.
fn shows_surface(sample: Surface, p: vec2<i32>) -> bool {
    let here = now[p.y * frame.width + p.x];
    if (sample.stencil != here.stencil) { return false; }
    if (is_none(sample.normal) && is_none(here.normal)) { return true; }  // a background
    let cosine = here.normal.x * sample.normal.x + here.normal.y * sample.normal.y + here.normal.z * sample.normal.z;
    if (here.stencil != 0.0) { return cosine >= 0.95; }
    return cosine >= 0.5 && is_near(sample.position - here.position, 4.0 * squared_footprint(p));
}

// Not the taps of a bilinear reading: what lies outside the frame is no sample.
@compute @workgroup_size(8, 8)
fn find_samples(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= frame.width || p.y >= frame.height) { return; }
    let index = p.y * frame.width + p.x;
    let place = lead(p, motion[index], frame);
    if (valid[index] != 0.0 || !place.finite) { return; }
    var sum = vec4<f32>(0.0);
    for (var i = 0; i < 4; i++) {
        let q = place.at + vec2<i32>(i & 1, i >> 1);
        if (any(q < vec2<i32>(0)) || q.x >= frame.width || q.y >= frame.height) { continue; }
        let other = q.y * frame.width + q.x;
        if (shows_surface(earlier[other], p)) {
            sum += vec4<f32>(max(vec3<f32>(0.0), vec3<f32>(color[3 * other], color[3 * other + 1], color[3 * other + 2])), 1.0);
        }
    }
    if (sum.w > 0.0) { samples[index] = vec4<f32>(sum.xyz / sum.w, sum.w); }
}

fn mixed(index: i32) -> bool { return squared(now[index].normal) < 0.25; }

fn base_color_at(index: i32) -> vec3<f32> {
    return vec3<f32>(base_color[3 * index], base_color[3 * index + 1], base_color[3 * index + 2]);
}

// How alike two pixels' materials are, 0 to 1; of a background `away` counts, the squared distance in pixels.
fn likeness(index: i32, own: i32, away: i32) -> f32 {
    let background = is_none(now[own].normal);
    if (is_none(now[index].normal) != background) { return 0.0; }
    let apart = abs(base_color_at(index) - base_color_at(own));
    let unlike = 1.0 + apart.x + apart.y + apart.z + 2.0 * squared(now[index].normal - now[own].normal)
        + select(0.0, 0.25 * f32(away), background);
    let square = unlike * unlike;
    return 1.0 / (square * square);
}

// The display-referred colour of a base colour in light 1; 1 for holes whose own base colour is a mean with a background's.
fn brightness(index: i32, is_mixed: bool) -> vec3<f32> {
    return select(sqrt(clamp(base_color_at(index), vec3<f32>(0.0), vec3<f32>(1.0)) + 0.015625), vec3<f32>(1.0), is_mixed);
}

@compute @workgroup_size(8, 8)
fn find_lights(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= frame.width || p.y >= frame.height) { return; }
    let index = p.y * frame.width + p.x;
    if (valid[index] != 0.0) { return; }
    if (samples[index].w > 0.0 && now[index].stencil == 0.0) { return; }  // a moving object's are known by normals alone
    let is_mixed = mixed(index);
    var sum = vec3<f32>(0.0);
    var total = vec3<f32>(0.0);
    for (var step = 1; step <= LARGEST_STEP; step *= 2) {
        for (var j = -REACH; j <= REACH; j++) {
            for (var i = -REACH; i <= REACH; i += select(2 * REACH, 1, abs(j) == REACH)) {
                let x = p.x + step * i;
                let y = p.y + step * j;
                if (x < 0 || x >= frame.width || y < 0 || y >= frame.height) { continue; }
                let other = y * frame.width + x;
                let is_valid = valid[other] != 0.0;
                if (now[other].stencil != now[index].stencil || !(is_valid || samples[other].w > 0.0)) { continue; }
                let weight = likeness(other, index, (x - p.x) * (x - p.x) + (y - p.y) * (y - p.y));
                let warped = vec3<f32>(filled[3 * other], filled[3 * other + 1], filled[3 * other + 2]);
                let a = brightness(other, is_mixed);
                sum += weight * a * select(samples[other].xyz, warped, is_valid);
                total += weight * a * a;
            }
        }
    }
    if (all(total > vec3<f32>(0.0))) { lights[index] = vec4<f32>(sum / total, 1.0); }
}

@compute @workgroup_size(8, 8)
fn fill(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= frame.width || p.y >= frame.height) { return; }
    let index = p.y * frame.width + p.x;
    if (valid[index] != 0.0) { return; }
    var found = samples[index].xyz;
    if (lights[index].w > 0.0) {
        var sum = vec3<f32>(0.0);
        var total = 0.0;
        for (var y = max(p.y - LIGHT_REACH, 0); y <= min(p.y + LIGHT_REACH, frame.height - 1); y++) {
            for (var x = max(p.x - LIGHT_REACH, 0); x <= min(p.x + LIGHT_REACH, frame.width - 1); x++) {
                let other = y * frame.width + x;
                if (lights[other].w == 0.0 || now[other].stencil != now[index].stencil || mixed(other) != mixed(index)) { continue; }
                let weight = likeness(other, index, 0);
                sum += weight * lights[other].xyz;
                total += weight;
            }
        }
        found = brightness(index, mixed(index)) * sum / total;
    } else if (samples[index].w == 0.0) {
        return;
    }
    filled[3 * index] = found.x;
    filled[3 * index + 1] = found.y;
    filled[3 * index + 2] = found.z;
}
