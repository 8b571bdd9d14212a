// SPDX-License-Identifier: MIT
// A 3 x 3 convolution with zeros around the image, and the gate of a gated one: what the network's stages are made of.
// One invocation computes one number. That is slow, and the one to keep: a fast kernel is right where it agrees with this one.

struct Layer {
    width: i32, height: i32, inputs: i32,  // of what is read
    outputs: i32, stride: i32,             // of what is written: ceil(size / stride)
    pitch: i32, first: i32,                // channels of a written pixel, and where ours begin: a concatenation costs no copy
    relu: u32,
}

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> x: array<f32>;       // H W C
@group(0) @binding(2) var<storage, read> weight: array<f32>;  // output, input, row, column
@group(0) @binding(3) var<storage, read> bias: array<f32>;
@group(0) @binding(4) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(8, 8)
fn conv(@builtin(global_invocation_id) id: vec3<u32>) {
    let width = (layer.width + layer.stride - 1) / layer.stride;
    let height = (layer.height + layer.stride - 1) / layer.stride;
    let p = vec2<i32>(id.xy);
    let output = i32(id.z);
    if (p.x >= width || p.y >= height) { return; }

    var sum = bias[output];
    for (var u = 0; u < 3; u++) {
        let row = p.y * layer.stride + u - 1;  // centred at stride * p: with stride 2 as well there are zeros on all four sides
        if (row < 0 || row >= layer.height) { continue; }
        for (var v = 0; v < 3; v++) {
            let column = p.x * layer.stride + v - 1;
            if (column < 0 || column >= layer.width) { continue; }
            let pixel = (row * layer.width + column) * layer.inputs;
            for (var c = 0; c < layer.inputs; c++) {
                sum += weight[((output * layer.inputs + c) * 3 + u) * 3 + v] * x[pixel + c];
            }
        }
    }
    if (layer.relu != 0u) { sum = max(sum, 0.0); }
    y[(p.y * width + p.x) * layer.pitch + layer.first + output] = sum;
}

// feature * sigmoid(mask), in the place of the feature. exp(-x) overflows for a gate far below 0; exp(-|x|) does not.
@group(0) @binding(5) var<storage, read> mask: array<f32>;

@compute @workgroup_size(64)
fn gate(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&mask)) { return; }
    let small = exp(-abs(mask[id.x]));
    let open = select(small, 1.0, mask[id.x] >= 0.0) / (1.0 + small);
    for (var c = 0; c < layer.outputs; c++) {
        y[i32(id.x) * layer.outputs + c] *= open;
    }
}
