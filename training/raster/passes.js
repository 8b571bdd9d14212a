// SPDX-License-Identifier: MIT
// One pass draws colour, G-buffer and motion into five targets: the same triangles with the same discards, so all agree at every pixel.
import * as THREE from 'three';
import {FullScreenQuad} from 'three/addons/postprocessing/Pass.js';

export const uniforms = {
  previousView: {value: new THREE.Matrix4()}, // projection * view of the display frame before
  currentView: {value: new THREE.Matrix4()},
  pixels: {value: new THREE.Vector2()},
  bias: {value: 0},
  time: {value: 0},
  previousTime: {value: 0},
};
const STILL = new THREE.Matrix4();
const DECLARE = `
  layout(location = 1) out highp vec4 outBase;
  layout(location = 2) out highp vec4 outNormal;
  layout(location = 3) out highp vec4 outPosition;
  layout(location = 4) out highp vec4 outMotion;
  uniform mat4 previousView, currentView;
  uniform vec2 pixels;
  vec2 motionFrom(vec4 before, vec4 now) {
    vec4 a = previousView * before, b = currentView * now;
    return a.w <= 0.0 ? vec2(1e4) : (a.xy / a.w - b.xy / b.w) * 0.5 * pixels * vec2(1.0, -1.0);
  }
`;
const BIASED = '#undef texture2D\n#define texture2D(map, at) texture(map, at, bias)\n';
// Without three.js's noise in the edges of shadows.
THREE.ShaderChunk.shadowmap_pars_fragment =
  THREE.ShaderChunk.shadowmap_pars_fragment.replaceAll('interleavedGradientNoise( gl_FragCoord.xy )', '0.0');

// Make a MeshStandardMaterial write the planes. id: of a moving object, or 0; step: what takes its world positions one frame back;
// wind: how far plants sway, metres per metre of height.
export function writePlanes(material, {id = 0, step = STILL, wind = 0} = {}) {
  material.onBeforeCompile = shader => {
    Object.assign(shader.uniforms, uniforms, {id: {value: id}, step_: {value: step}, wind: {value: wind}});
    shader.vertexShader = `varying vec3 at_, before_; uniform mat4 step_; uniform float time, previousTime, wind;
      vec3 sway(vec3 p, vec3 root, float t) {
        return p + wind * clamp(p.y, 0.0, 3.0) * vec3(sin(2.3 * t + 0.7 * root.x + 0.3 * root.z), 0.0, cos(1.9 * t + 0.8 * root.z));
      }\n` + shader.vertexShader
      .replace('#include <begin_vertex>', `#include <begin_vertex>
        vec3 root = modelMatrix[3].xyz, then_ = sway(transformed, root, previousTime);
        transformed = sway(transformed, root, time);`)
      .replace('#include <project_vertex>', `#include <project_vertex>
        at_ = (modelMatrix * vec4(transformed, 1.0)).xyz;
        before_ = (step_ * modelMatrix * vec4(then_, 1.0)).xyz;`);
    shader.fragmentShader = DECLARE + 'varying vec3 at_, before_; uniform float id, bias;\n' + BIASED + shader.fragmentShader
      .replace('#include <dithering_fragment>', `#include <dithering_fragment>
        outBase = vec4(diffuseColor.rgb, roughnessFactor);
        outNormal = vec4((vec4(normal, 0.0) * viewMatrix).xyz, metalnessFactor);
        outPosition = vec4(at_, vViewPosition.z);
        outMotion = vec4(motionFrom(vec4(before_, 1.0), vec4(at_, 1.0)), id, dot(normal, normalize(vViewPosition)));`);
  };
  return material;
}

// The sky is at infinity: depth 0 says that nothing was hit.
export function sky(texture, gain) {
  const mesh = new THREE.Mesh(new THREE.SphereGeometry(1, 32, 16), new THREE.ShaderMaterial({
    side: THREE.BackSide, depthWrite: false,
    uniforms: {...uniforms, sky: {value: texture}, gain: {value: gain}},
    vertexShader: `varying vec3 direction;
      void main() {
        direction = position;
        vec4 p = projectionMatrix * vec4(mat3(viewMatrix) * position, 1.0);
        gl_Position = vec4(p.xy, 0.9999995 * p.w, p.w);
      }`,
    fragmentShader: DECLARE + `varying vec3 direction; uniform sampler2D sky; uniform float gain;
      void main() {
        vec3 d = normalize(direction);
        vec2 uv = vec2(atan(d.z, d.x) * 0.15915494 + 0.5, asin(clamp(d.y, -1.0, 1.0)) * 0.31830989 + 0.5);
        gl_FragColor = vec4(textureLod(sky, uv, 0.0).rgb * gain, 1.0);
        outBase = outNormal = outPosition = vec4(0.0);
        outMotion = vec4(motionFrom(vec4(d, 0.0), vec4(d, 0.0)), 0.0, 0.0);
      }`}));
  mesh.frustumCulled = false;
  mesh.renderOrder = 1;
  return mesh;
}

// Each pixel is the mean of side x side texels: read back whole, the samples of one frame would be half a gigabyte.
const mean = new FullScreenQuad(new THREE.ShaderMaterial({
  uniforms: {samples: {value: null}, side: {value: 1}},
  vertexShader: 'void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }',
  fragmentShader: `uniform sampler2D samples; uniform int side;
    void main() {
      vec4 sum = vec4(0.0);
      for (int y = 0; y < side; ++y)
        for (int x = 0; x < side; ++x) sum += texelFetch(samples, ivec2(gl_FragCoord.xy) * side + ivec2(x, y), 0);
      gl_FragColor = sum / float(side * side);
    }`}));

export class Passes {
  // width, height: of the low resolution; side * side samples a pixel of the truth
  constructor(renderer, width, height, side) {
    const options = {type: THREE.FloatType, minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter};
    this.renderer = renderer;
    this.side = side;
    this.low = new THREE.WebGLRenderTarget(width, height, {...options, count: 5});
    this.high = new THREE.WebGLRenderTarget(2 * side * width, 2 * side * height, options);
    this.mean = new THREE.WebGLRenderTarget(2 * width, 2 * height, options);
    uniforms.pixels.value.set(width, height);
  }

  draw(scene, camera, target, bias) {
    uniforms.bias.value = bias;
    this.renderer.setRenderTarget(target);
    this.renderer.clear();
    this.renderer.render(scene, camera);
  }

  dispose() {
    this.low.dispose();
    this.high.dispose();
    this.mean.dispose();
  }

  // The five planes, each (height, width, 4) from the bottom up.
  planes(scene, camera, bias) {
    const {width, height} = this.low, read = [];
    this.draw(scene, camera, this.low, bias);
    for (let i = 0; i < 5; i++) {
      read.push(new Float32Array(4 * width * height));
      this.renderer.readRenderTargetPixels(this.low, 0, 0, width, height, read[i], undefined, i);
    }
    return read;
  }

  // The mean over side x side samples at twice the size. Textures are as blurred as without the samples: hence the bias.
  truth(scene, camera) {
    const {width, height} = this.mean, pixels = new Float32Array(4 * width * height);
    this.draw(scene, camera, this.high, Math.log2(this.side));
    mean.material.uniforms.samples.value = this.high.texture;
    mean.material.uniforms.side.value = this.side;
    this.renderer.setRenderTarget(this.mean);
    mean.render(this.renderer);
    this.renderer.readRenderTargetPixels(this.mean, 0, 0, width, height, pixels);
    return pixels;
  }
}
