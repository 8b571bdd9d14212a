// Plays the calls that page.py wrote down, on the browser's WebGPU device.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const [state, chosen, all, split] = ["state", "frame", "all", "split"].map((id) => document.getElementById(id));
const usage = { storage: 0x80, uniform: 0x40, copySource: 0x4, copyTarget: 0x8, read: 0x1 };
let device, arrays;
const pipelines = new Map();

// The arrays of the page, as Float32Array.
async function unpack() {
  const packed = Uint8Array.from(atob(data.packed), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = await new Response(stream).arrayBuffer();
  let at = 0;
  return data.sizes.map((size) => new Float32Array(bytes, (at += size) * 4 - size * 4, size));
}

// The best device, with buffers as large as it allows.
async function open() {
  if (!navigator.gpu) throw new Error("this browser has no WebGPU");
  const adapter = await navigator.gpu.requestAdapter({ powerPreference: "high-performance" });
  if (!adapter) throw new Error("no WebGPU device");
  const { maxBufferSize, maxStorageBufferBindingSize } = adapter.limits;
  const opened = await adapter.requestDevice({ requiredLimits: { maxBufferSize, maxStorageBufferBindingSize } });
  const { vendor, architecture, description } = adapter.info;
  return [opened, [vendor, architecture, description].filter(Boolean).join(" ") || "unnamed"];
}

// An entry point, compiled once.
function pipeline(entry) {
  if (!pipelines.has(entry)) {
    const [file, entryPoint] = entry.split(".");
    const module = device.createShaderModule({ code: data.shaders[file] });
    pipelines.set(entry, device.createComputePipeline({ layout: "auto", compute: { module, entryPoint } }));
  }
  return pipelines.get(entry);
}

function filled(array, kind) {
  const buffer = device.createBuffer({ size: array.byteLength, usage: kind | usage.copyTarget });
  device.queue.writeBuffer(buffer, 0, array);
  return buffer;
}

// The image of a frame, (2H, 2W, 3) as Float32Array, and the seconds that it took.
async function play(frame) {
  const start = performance.now(), kind = usage.storage | usage.copySource;
  const buffers = frame.buffers.map((b) => (Array.isArray(b) ? filled(arrays[b[0]], kind) : device.createBuffer({ size: 4 * b, usage: kind })));
  const encoder = device.createCommandEncoder(), uniforms = [];
  for (const [entry, groups, uniform, bindings] of frame.calls) {
    uniforms.push(filled(Int32Array.from({ length: 12 }, (_, i) => Number(uniform[i] ?? 0)), usage.uniform));
    const bound = [[0, uniforms.at(-1)], ...Object.entries(bindings).map(([i, b]) => [Number(i), buffers[b]])];
    const pass = encoder.beginComputePass();
    pass.setPipeline(pipeline(entry));
    pass.setBindGroup(0, device.createBindGroup({
      layout: pipeline(entry).getBindGroupLayout(0),
      entries: bound.map(([binding, buffer]) => ({ binding, resource: { buffer } })),
    }));
    pass.dispatchWorkgroups(...groups);
    pass.end();
  }
  const [result, height, width] = frame.image, size = height * width * 3 * 4;
  const read = device.createBuffer({ size, usage: usage.read | usage.copyTarget });
  encoder.copyBufferToBuffer(buffers[result], 0, read, 0, size);
  device.queue.submit([encoder.finish()]);
  await read.mapAsync(1);
  const image = new Float32Array(read.getMappedRange().slice(0));
  for (const buffer of [...buffers, ...uniforms, read]) buffer.destroy();
  return [image, (performance.now() - start) / 1000];
}

function draw(id, image, height, width) {
  const canvas = document.getElementById(id), shown = new ImageData(width, height);
  for (let i = 0; i < height * width; i++) {
    for (let c = 0; c < 3; c++) shown.data[4 * i + c] = Math.round(255 * Math.min(Math.max(image[3 * i + c], 0), 1));
    shown.data[4 * i + 3] = 255;
  }
  Object.assign(canvas, { width, height });
  canvas.getContext("2d").putImageData(shown, 0, 0);
}

async function show(number) {
  const frame = data.frames[number], [image, seconds] = await play(frame);
  draw("stss", image, frame.image[1], frame.image[2]);
  draw("enlarged", arrays[frame.color[0]], frame.color[1], frame.color[2]);
  chosen.value = number;
  return [image, seconds];
}

function cover() {
  document.getElementById("enlarged").style.clipPath = `inset(0 ${100 - split.value}% 0 0)`;
}

async function begin() {
  arrays = await unpack();
  const [opened, name] = await open();
  device = opened;
  device.addEventListener("uncapturederror", (event) => { state.textContent = event.error.message; });
  chosen.append(...data.frames.map((frame, i) => new Option(frame.name, i)));
  const tell = async (i) => { state.textContent = `${name}: ${data.frames[i].name}, ${((await show(i))[1] * 1000).toFixed(0)} ms`; };
  chosen.addEventListener("change", () => tell(Number(chosen.value)));
  split.addEventListener("input", cover);
  all.addEventListener("click", async () => { for (let i = 0; i < data.frames.length; i++) await tell(i); });
  cover();
  await tell(0);
  chosen.disabled = all.disabled = false;
}

begin().catch((error) => { state.textContent = `cannot run here: ${error.message}`; });
