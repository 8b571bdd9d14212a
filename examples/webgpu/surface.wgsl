// SPDX-License-Identifier: MIT
// The current surfaces, and how far apart those of neighbouring pixels lie: after follow.wgsl the beginning of holes.wgsl and reshade.wgsl.

struct Surface { normal: vec3<f32>, stencil: f32, position: vec3<f32>, unused: f32 }

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(3) var<storage, read> now: array<Surface>;

fn squared(v: vec3<f32>) -> f32 { return v.x * v.x + v.y * v.y + v.z * v.z; }

// Whether an offset is no longer than a limit, by their squares. Not if it is not finite; a comparison need not say so in WGSL.
fn is_near(offset: vec3<f32>, squared_limit: f32) -> bool {
    return is_finite(offset.x) && is_finite(offset.y) && is_finite(offset.z) && squared(offset) <= squared_limit;
}

// The squared distance to another pixel's position; far beyond any other outside the frame, or where it is not finite.
const NOWHERE = 3e38;
fn apart(p: vec2<i32>, other: vec2<i32>) -> f32 {
    if (any(other < vec2<i32>(0)) || other.x >= frame.width || other.y >= frame.height) { return NOWHERE; }
    let between = now[other.y * frame.width + other.x].position - now[p.y * frame.width + p.x].position;
    let found = squared(between);
    return select(NOWHERE, found, is_finite(found));
}

// The nearer of the two neighbours along an axis; 0 where there is none.
fn nearer(p: vec2<i32>, axis: vec2<i32>) -> f32 {
    let found = min(apart(p, p - axis), apart(p, p + axis));
    return select(0.0, found, found < NOWHERE);
}

// The square of a pixel's footprint.
fn squared_footprint(p: vec2<i32>) -> f32 {
    return nearer(p, vec2<i32>(1, 0)) + nearer(p, vec2<i32>(0, 1));
}
