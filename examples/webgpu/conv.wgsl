// SPDX-License-Identifier: MIT
// A convolution with zeros around the image, and the gate of a gated one: the parts of the network's stages.
// One invocation computes one number. That is slow, and the one to keep: a fast kernel is right where it agrees with this one.

struct Layer {
    width: i32, height: i32, inputs: i32,  // of the input
    outputs: i32, stride: i32,             // of the output: ceil(size / stride)
    relu: i32, reach: i32,                 // reach: 1 in a window of 3 x 3, 0 in one of 1 x 1
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
    let side = 2 * layer.reach + 1;
    for (var u = 0; u < side; u++) {
        let row = p.y * layer.stride + u - layer.reach;  // centred at stride * p: with stride 2 as well there are zeros on all four sides
        if (row < 0 || row >= layer.height) { continue; }
        for (var v = 0; v < side; v++) {
            let column = p.x * layer.stride + v - layer.reach;
            if (column < 0 || column >= layer.width) { continue; }
            let pixel = (row * layer.width + column) * layer.inputs;
            for (var c = 0; c < layer.inputs; c++) {
                sum += weight[((output * layer.inputs + c) * side + u) * side + v] * x[pixel + c];
            }
        }
    }
    if (layer.relu != 0) { sum = max(sum, 0.0); }
    y[(p.y * width + p.x) * layer.outputs + output] = sum;
}

// feature * sigmoid(mask), in the place of the feature. exp(-x) overflows for a gate far below 0; exp(-|x|) does not.
@group(0) @binding(5) var<storage, read> mask: array<f32>;

@compute @workgroup_size(8, 8)
fn gate(@builtin(global_invocation_id) id: vec3<u32>) {
    let p = vec2<i32>(id.xy);
    if (p.x >= layer.width || p.y >= layer.height) { return; }
    let index = p.y * layer.width + p.x;
    let small = exp(-abs(mask[index]));
    let shut = small / (1.0 + small);
    // 1 - e / (1 + e), not 1 / (1 + e): a gate that is wide open is exactly 1 however the device divides.
    let open = select(shut, 1.0 - shut, mask[index] >= 0.0);
    for (var c = 0; c < layer.outputs; c++) {
        y[index * layer.outputs + c] *= open;
    }
}
