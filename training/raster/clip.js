// SPDX-License-Identifier: MIT
// One clip of make.py: a track, a sky with its sun, karts on the road, a camera. 60 display frames a second.
import * as THREE from 'three';
import {EXRLoader} from 'three/addons/loaders/EXRLoader.js';
import {Passes, sky, uniforms} from './passes.js';
import {loadBoxes, loadKart, loadRoad, loadRoom, loadTrack, once} from './stk.js';

const RATE = 60, SHADOW = 40; // frames a second; half the side of the shadowed square, metres
const post = (name, data) => fetch(`/${name}`, {method: 'POST', body: data});

// The sky as a panorama, and what it lights.
const loadSky = (renderer, name) => once(`sky ${name}`, async () => {
  const data = (await import(`/modules/@pmndrs/assets/hdri/${name}.exr.js`)).default;
  const panorama = await new EXRLoader().setDataType(THREE.FloatType).loadAsync(data);
  panorama.wrapS = THREE.RepeatWrapping;
  return {panorama, light: new THREE.PMREMGenerator(renderer).fromEquirectangular(panorama).texture};
});

async function lightScene(scene, renderer, clip) {
  const {panorama, light} = await loadSky(renderer, clip.sky);
  scene.environment = light;
  scene.environmentIntensity = 0.5;
  scene.add(sky(panorama, clip.skyGain));
  const sun = new THREE.DirectionalLight(clip.sunColor, clip.sunPower), box = sun.shadow.camera;
  sun.castShadow = true;
  sun.shadow.mapSize.set(1024, 1024);
  sun.shadow.normalBias = 0.05;
  Object.assign(box, {left: -SHADOW, right: SHADOW, bottom: -SHADOW, top: SHADOW, near: 1, far: 220});
  scene.add(sun, sun.target);
  return (eye, forward) => {
    sun.target.position.copy(eye).addScaledVector(forward, 0.7 * SHADOW);
    sun.position.set(...clip.sun).normalize().multiplyScalar(100).add(sun.target.position);
    sun.target.updateMatrixWorld();
  };
}

// Where the road is after so many metres, and the way it goes there, in a world with z mirrored whose origin is the clip's start.
async function roadOf(clip) {
  if (clip.room) return {at: metres => new THREE.Vector3(0, 0, -metres), along: () => new THREE.Vector3(0, 0, -1), first: new THREE.Vector3()};
  const road = await loadRoad(clip.track);
  road.arcLengthDivisions = 4000;
  const length = road.getLength(), first = road.getPointAt(clip.start);
  const at = metres => road.getPointAt(((clip.start + metres / length) % 1 + 1) % 1).sub(first).multiply(new THREE.Vector3(1, 1, -1));
  const along = metres => at(metres + 2).sub(at(metres)).normalize();
  return {at, along, first};
}

function moveCamera(camera, road, clip, time) {
  const metres = clip.camera === 'fly' ? clip.speed * time : 0, forward = road.along(metres), aside = new THREE.Vector3(-forward.z, 0, forward.x);
  camera.position.copy(road.at(metres)).addScaledVector(aside, clip.aside);
  camera.position.y += clip.height + (clip.camera === 'fly' ? 0.04 * Math.sin(9 * time) : 0);
  camera.lookAt(camera.position.clone().add(road.along(metres + 8)));
  camera.rotateY(clip.yaw + (clip.camera === 'pan' ? clip.turn * time : 0));
  camera.rotateX(clip.pitch);
  camera.updateMatrixWorld(true);
}

// Put an object whose parent mirrors z so many metres along the road, aside of it and above it, turned along it.
function place(object, road, {ahead, aside, up}) {
  const forward = road.along(ahead), left = new THREE.Vector3(-forward.z, 0, forward.x);
  object.position.copy(road.at(ahead)).addScaledVector(left, aside);
  object.position.z *= -1;
  object.position.y += up;
  object.rotation.y = Math.atan2(forward.x, -forward.z);
}

function moveKart(kart, road, {ahead, speed, aside, spin, lift = 0, tumble = 0}, time) {
  place(kart.group, road, {ahead: ahead + speed * time, aside, up: lift});
  kart.group.rotation.x = tumble * (1 + time);
  kart.group.rotation.y += (speed < 0 ? Math.PI : 0) + spin * time;
  for (const wheel of kart.wheels) wheel.rotation.x = Math.abs(speed) * time / 0.25;
  kart.move();
}

// The clips share one renderer, whose programs take most of the time to build, and what was loaded for a clip before.
export async function renderClips(clips) {
  const renderer = new THREE.WebGLRenderer();
  renderer.shadowMap.enabled = true;
  renderer.shadowMap.autoUpdate = false;
  for (const clip of clips) await renderClip(renderer, clip);
}

// Have textures read so many times along the longer side of a pixel's footprint.
function sharpen(scene, anisotropy) {
  scene.traverse(({material}) => {
    for (const texture of [material?.map, material?.normalMap, material?.roughnessMap].filter(t => t && t.anisotropy !== anisotropy)) {
      texture.anisotropy = anisotropy;
      texture.needsUpdate = true;
    }
  });
}

async function renderClip(renderer, clip) {
  const started = performance.now(), scene = new THREE.Scene(), mirrored = new THREE.Group(), road = await roadOf(clip);
  const track = clip.room ? await loadRoom(clip.room) : await loadTrack(clip.track);
  mirrored.scale.z = -1;
  track.position.copy(road.first).negate();
  mirrored.add(track);
  scene.add(mirrored);
  mirrored.add(await loadBoxes(clip.boxes ?? [], (box, at) => place(box, road, at)));
  const karts = [];
  for (const [i, kart] of clip.karts.entries()) karts.push(await loadKart(kart.name, i + 1));
  mirrored.add(...karts.map(k => k.group));
  sharpen(scene, clip.anisotropy);
  const aimSun = await lightScene(scene, renderer, clip), [width, height] = clip.size, eyes = [];
  console.log(`${clip.name}: loaded after ${Math.round(performance.now() - started)} ms`);
  const camera = new THREE.PerspectiveCamera(clip.fov, width / height, 0.2, 800), passes = new Passes(renderer, width, height, clip.samples);
  for (let frame = -1; frame < clip.frames; frame++) {
    const time = frame / RATE;
    uniforms.time.value = time;
    uniforms.previousTime.value = (frame - 1) / RATE;
    if (clip.jitter) camera.setViewOffset(width, height, ...clip.jitter[Math.max(frame, 0)], width, height);
    moveCamera(camera, road, clip, time);
    if (frame < 0) aimSun(camera.position, camera.getWorldDirection(new THREE.Vector3()));
    karts.forEach((kart, i) => moveKart(kart, road, clip.karts[i], time));
    uniforms.previousView.value.copy(uniforms.currentView.value);
    uniforms.currentView.value.multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
    if (frame < 0) continue;
    renderer.shadowMap.needsUpdate = true;
    for (const [i, plane] of passes.planes(scene, camera, clip.bias).entries()) await post(`${clip.name}.${frame}.${i}`, plane);
    if (clip.steady) camera.clearViewOffset();
    if (clip.truths.includes(frame)) await post(`${clip.name}.${frame}.truth`, passes.truth(scene, camera));
    eyes.push(camera.position.toArray());
  }
  await post(`${clip.name}.eyes.json`, JSON.stringify(eyes));
  passes.dispose();
  console.log(`${clip.name}: ${Math.round((performance.now() - started) / 1000)} s`);
}
