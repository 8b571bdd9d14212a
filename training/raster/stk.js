// SPDX-License-Identifier: MIT
// SuperTuxKart's files: meshes (SPM), materials.xml, a track's scene.xml, library nodes, karts. All in its left-handed coordinates.
import * as THREE from 'three';
import {writePlanes} from './passes.js';

const SHARED = '/stk/textures/';
const kept = new Map();
export const once = (key, make) => kept.get(key) ?? kept.set(key, make()).get(key);
const listing = folder => once(`list ${folder}`, async () => (await fetch(folder)).json());

export const xml = url => once(`xml ${url}`, async () => {
  const response = await fetch(url);
  return response.ok ? new DOMParser().parseFromString(await response.text(), 'text/xml').documentElement : null;
});
const numbers = (element, name, otherwise) => (element.getAttribute(name) ?? otherwise).trim().split(/\s+/).map(Number);

async function find(name, folders) {
  for (const folder of folders) {
    const entry = (await listing(folder)).find(e => e.toLowerCase() === name.toLowerCase());
    if (entry) return folder + entry;
  }
  return null;
}

// Little-endian reader.
class Bytes {
  constructor(buffer) { this.view = new DataView(buffer); this.at = 0; }
  skip(n) { this.at += n; return this; }
  u8() { return this.view.getUint8(this.at++); }
  u16() { this.at += 2; return this.view.getUint16(this.at - 2, true); }
  u32() { this.at += 4; return this.view.getUint32(this.at - 4, true); }
  f16() { return THREE.DataUtils.fromHalfFloat(this.u16()); }
  f32() { this.at += 4; return this.view.getFloat32(this.at - 4, true); }
  text() { return String.fromCharCode(...Array.from({length: this.u8()}, () => this.u8())); }
}
const tenBits = (word, place) => ((word >> 10 * place & 1023) << 22 >> 22) / 511;

// The parts of a mesh: [{geometry, texture}].
async function meshParts(url) {
  const response = await fetch(url);
  if (!response.ok) return [];
  const bytes = new Bytes(await response.arrayBuffer());
  const kind = bytes.skip(2).u8() & 7, flags = bytes.u8(); // kind 0: track, 1: skinned, 2: static
  const textures = Array.from({length: bytes.skip(24).u16()}, () => [bytes.text(), bytes.text()]);
  const parts = [];
  for (let sectors = bytes.u16(); sectors > 0; sectors--) {
    for (let count = bytes.u16(); count > 0; count--) parts.push(meshPart(bytes, textures, flags, kind === 1));
    if (kind === 0) bytes.skip(24);
  }
  return parts;
}

function meshPart(bytes, textures, flags, skinned) {
  const vertices = bytes.u32(), indices = bytes.u32(), [texture, second] = textures[bytes.u16()];
  const position = [], normal = [], color = [], uv = [];
  for (let v = 0; v < vertices; v++) {
    position.push(bytes.f32(), bytes.f32(), bytes.f32());
    if (flags & 1) { const word = bytes.u32(); normal.push(tenBits(word, 0), tenBits(word, 1), tenBits(word, 2)); }
    const white = !(flags & 2) || bytes.u8() === 128;
    for (let c = 0; c < 3; c++) color.push(white ? 1 : (bytes.u8() / 255) ** 2.2);
    if (texture) uv.push(bytes.f16(), bytes.f16()); else uv.push(0, 0);
    bytes.skip((texture && second ? 4 : 0) + (texture && flags & 4 ? 4 : 0) + (skinned ? 16 : 0));
  }
  const index = Array.from({length: indices}, () => vertices > 65535 ? bytes.u32() : vertices > 255 ? bytes.u16() : bytes.u8());
  const geometry = new THREE.BufferGeometry();
  for (const [name, list, size] of [['position', position, 3], ['color', color, 3], ['uv', uv, 2]])
    geometry.setAttribute(name, new THREE.Float32BufferAttribute(list, size));
  geometry.setIndex(index);
  if (flags & 1) geometry.setAttribute('normal', new THREE.Float32BufferAttribute(normal, 3));
  else geometry.computeVertexNormals();
  return {geometry, texture};
}

// Name of a texture -> attributes of its material; the first folder wins.
const materialTable = folders => once(`table ${folders}`, async () => {
  const table = {};
  for (const folder of folders.toReversed())
    for (const m of (await xml(`${folder}materials.xml`))?.querySelectorAll('material') ?? [])
      table[m.getAttribute('name')] = Object.fromEntries([...m.attributes].map(a => [a.name, a.value]));
  return table;
});

async function pixels(url, size) {
  const bitmap = await createImageBitmap(await (await fetch(url)).blob(), {premultiplyAlpha: 'none', colorSpaceConversion: 'none'});
  const canvas = new OffscreenCanvas(size?.width ?? bitmap.width, size?.height ?? bitmap.height), context = canvas.getContext('2d');
  context.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  return context.getImageData(0, 0, canvas.width, canvas.height);
}

// change(bytes of a pixel's R, G, B, A at i) edits the image first.
function texture(image, space, change = null) {
  if (change) for (let i = 0; i < image.data.length; i += 4) change(image.data, i);
  const made = new THREE.DataTexture(new Uint8Array(image.data.buffer), image.width, image.height);
  made.wrapS = made.wrapT = THREE.RepeatWrapping;
  made.colorSpace = space;
  made.generateMipmaps = true;
  made.magFilter = THREE.LinearFilter;
  made.minFilter = THREE.LinearMipmapLinearFilter;
  made.needsUpdate = true;
  return made;
}

async function material(name, folders, table) {
  const m = table[name] ?? {}, shader = m.shader ?? 'solid', url = await find(name, folders);
  if (!url || shader === 'additive') return null;
  const cut = /alphatest|grass|alphablend/.test(shader), image = await pixels(url), mask = m.mask && await find(m.mask, folders);
  const alpha = mask && (await pixels(mask, image)).data;
  const options = {
    vertexColors: true, roughness: shader === 'displace' ? 0.15 : 0.9, metalness: 0, alphaTest: cut ? 0.5 : 0,
    side: cut || m['backface-culling'] === 'N' ? THREE.DoubleSide : THREE.FrontSide,
    map: texture(image, THREE.SRGBColorSpace, alpha && ((p, i) => { p[i + 3] = alpha[i]; })),
  };
  if (shader === 'unlit') Object.assign(options, {emissive: '#fff', emissiveMap: options.map});
  const normals = m['normal-map'] && await find(m['normal-map'], folders), gloss = m['gloss-map'] && await find(m['gloss-map'], folders);
  if (normals) options.normalMap = texture(await pixels(normals), THREE.NoColorSpace);
  if (gloss) {
    const map = texture(await pixels(gloss), THREE.NoColorSpace, (p, i) => { [p[i + 1], p[i + 2]] = [255 - p[i], p[i + 1]]; });
    Object.assign(options, {roughness: 1, metalness: 1, roughnessMap: map, metalnessMap: map});
  }
  return writePlanes(new THREE.MeshStandardMaterial(options), {wind: shader === 'grass' ? 0.04 : 0});
}

async function model(url, folders, table) {
  const group = new THREE.Group();
  for (const part of await once(url, () => meshParts(url))) {
    const found = part.texture && await once(`${part.texture} ${folders}`, () => material(part.texture, folders, table));
    if (!found) continue;
    const mesh = new THREE.Mesh(part.geometry, found);
    mesh.castShadow = mesh.receiveShadow = true;
    group.add(mesh);
  }
  return group;
}

// Degrees about x, then y, then z, left-handed.
function placement(element) {
  const at = element.hasAttribute('xyz') ? numbers(element, 'xyz') : ['x', 'y', 'z'].map(k => Number(element.getAttribute(k) ?? 0));
  const turn = numbers(element, 'hpr', '0 0 0').map(THREE.MathUtils.degToRad), scale = numbers(element, 'scale', '1 1 1');
  return new THREE.Matrix4().compose(new THREE.Vector3(...at),
    new THREE.Quaternion().setFromEuler(new THREE.Euler(...turn, 'ZYX')), new THREE.Vector3(scale[0], scale[1] ?? scale[0], scale[2] ?? scale[0]));
}

// Add the static models of scene.xml or of a library's node.xml to parent.
async function models(parent, element, folders, table, lods) {
  for (const child of element.children) {
    const type = child.getAttribute('type') ?? 'static', tag = child.tagName;
    if (!['track', 'static-object', 'object', 'library'].includes(tag) || child.hasAttribute('if')) continue;
    if (child.getAttribute('interaction') === 'physics-only' || !['animation', 'movable', 'static'].includes(type)) continue;
    const node = new THREE.Group();
    node.applyMatrix4(placement(child));
    parent.add(node);
    if (tag === 'library') {
      const folder = `/stk/library/${child.getAttribute('name')}/`;
      if (await xml(`${folder}node.xml`)) await place(node, `${folder}node.xml`, [folder, ...folders]);
      continue;
    }
    const name = child.hasAttribute('lod_instance') ? lods[child.getAttribute('lod_group')] : child.getAttribute('model');
    if (name) node.add(await model(folders[0] + name, folders, table));
    if (tag === 'track') await models(node, child, folders, table, lods);
  }
}

async function place(parent, url, folders) {
  const root = await xml(url), lods = {};
  for (const group of root.querySelectorAll('lod > group')) {
    const nearest = [...group.children].sort((a, b) => a.getAttribute('lod_distance') - b.getAttribute('lod_distance'))[0];
    if (nearest) lods[group.getAttribute('name')] = nearest.getAttribute('model');
  }
  await models(parent, root, folders, await materialTable(folders), lods);
}

export const loadTrack = name => once(`track ${name}`, async () => {
  const folder = `/stk/tracks/${name}/`, group = new THREE.Group();
  await place(group, `${folder}scene.xml`, [folder, SHARED]);
  return group;
});

// A floor and three walls: [texture, metres that it spans] of each; the road leads to the first wall, so many metres away. Things stand about.
export async function loadRoom({surfaces, width, depth, height, things}) {
  const group = new THREE.Group(), table = await materialTable([SHARED]), half = Math.PI / 2;
  const places = [
    [width, 2 * depth, [0, 0, 0], [-half, 0, 0]], [width, height, [0, height / 2, depth], [0, 2 * half, 0]],
    [2 * depth, height, [-width / 2, height / 2, 0], [0, half, 0]], [2 * depth, height, [width / 2, height / 2, 0], [0, -half, 0]]];
  for (const [i, [across, up, at, turn]] of places.entries()) {
    const [name, span] = surfaces[i], geometry = new THREE.PlaneGeometry(across, up), uv = geometry.attributes.uv;
    for (let v = 0; v < uv.count; v++) uv.setXY(v, uv.getX(v) * across / span, uv.getY(v) * up / span);
    geometry.setAttribute('color', new THREE.Float32BufferAttribute(new Array(3 * uv.count).fill(1), 3));
    const mesh = new THREE.Mesh(geometry, await once(`${name} ${SHARED}`, () => material(name, [SHARED], table)));
    mesh.position.set(...at);
    mesh.rotation.set(...turn);
    mesh.receiveShadow = true;
    group.add(mesh);
  }
  for (const {name, ahead, aside, turn} of things) {
    const node = new THREE.Group(), folder = `/stk/library/${name}/`;
    await place(node, `${folder}node.xml`, [folder, SHARED]);
    node.position.set(aside, 0, ahead);
    node.rotation.y = turn;
    node.traverse(({material}) => { if (material?.alphaTest) material.vertexColors = false; }); // they are wind, not light
    group.add(node);
  }
  return group;
}

// Boxes of width, height and length, whose middle is at a place.
export async function loadBoxes(boxes, place) {
  const group = new THREE.Group(), table = await materialTable([SHARED]);
  for (const {size, surface, ...at} of boxes) {
    const geometry = new THREE.BoxGeometry(...size);
    geometry.setAttribute('color', new THREE.Float32BufferAttribute(new Array(3 * geometry.attributes.position.count).fill(1), 3));
    const mesh = new THREE.Mesh(geometry, await once(`${surface} ${SHARED}`, () => material(surface, [SHARED], table)));
    place(mesh, at);
    mesh.castShadow = mesh.receiveShadow = true;
    group.add(mesh);
  }
  return group;
}

// The middle of the road, a curve.
export async function loadRoad(name) {
  const quads = [];
  for (const quad of (await xml(`/stk/tracks/${name}/quads.xml`)).querySelectorAll('quad')) {
    const corners = ['p0', 'p1', 'p2', 'p3'].map(p => quad.getAttribute(p)).filter(Boolean).map(text => {
      const [before, corner] = text.split(':').map(Number); // "7:2" is corner 2 of quad 7
      return text.includes(':') ? quads[before][corner] : new THREE.Vector3(...text.trim().split(/\s+/).map(Number));
    });
    if (corners.length === 4) quads.push(corners);
  }
  return new THREE.CatmullRomCurve3(quads.map(c => c[0].clone().add(c[1]).add(c[2]).add(c[3]).divideScalar(4)), true);
}

// A kart whose materials know its number and its step of motion.
export async function loadKart(name, id) {
  const folder = `/stk/karts/${name}/`, folders = [folder, SHARED], table = await materialTable(folders);
  const kart = await xml(`${folder}kart.xml`), group = await model(folder + kart.getAttribute('model-file'), folders, table), wheels = [];
  for (const wheel of kart.querySelector('wheels')?.children ?? []) {
    const node = await model(folder + wheel.getAttribute('model'), folders, table);
    node.position.set(...numbers(wheel, 'position'));
    group.add(node);
    wheels.push(node);
  }
  const meshes = [];
  group.traverse(mesh => {
    if (!mesh.isMesh) return;
    const step = new THREE.Matrix4();
    mesh.material = writePlanes(mesh.material.clone(), {id, step});
    meshes.push({mesh, step, before: null});
  });
  const move = () => {
    group.updateWorldMatrix(true, true);
    for (const m of meshes) {
      const now = m.mesh.matrixWorld.clone();
      m.step.multiplyMatrices(m.before ?? now, now.clone().invert());
      m.before = now;
    }
  };
  return {group, wheels, move};
}
