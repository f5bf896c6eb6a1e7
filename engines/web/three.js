/**
 * A take in a scene of three.js (r187): its Gaussians and the scene's meshes hide each other by depth, lamps and environment
 * of the scene light both, and each casts shadows on the other.
 *
 *     const person = await RelightObject.create(renderer, await Take.open("person.b4d"));
 *     scene.add(person);
 *     person.time = seconds; // in every frame
 *
 * The object's axes are three's: y up, metres. It draws in `onBeforeRender`, with the WebGL2 context of a `WebGLRenderer` or
 * the device of a `WebGPURenderer`. A host is what differs between them: `WebGLHost` here, `WebGPUHost` in three-webgpu.js.
 */

import * as THREE from "three";
import {Environment, Relight} from "./index.js";

const DISPLAY = `
uniform sampler2D lit;
uniform sampler2D depths;
uniform mat4 projection;
uniform float unit;
uniform float rows;
void main() {
  ivec2 cell = ivec2(gl_FragCoord.x, rows - gl_FragCoord.y);
  vec4 seen = texelFetch(lit, cell, 0);
  vec4 sums = texelFetch(depths, cell, 0);
  if (seen.a < 1.0 / 255.0) discard;
  float depth = sums.z / sums.w * unit;
  vec4 clip = projection * vec4(0.0, 0.0, -depth, 1.0);
  gl_FragDepth = clamp(0.5 + 0.5 * clip.z / clip.w, 0.0, 1.0);
  gl_FragColor = vec4(seen.rgb / seen.a, seen.a);
  #include <tonemapping_fragment>
  #include <colorspace_fragment>
  gl_FragColor.rgb *= gl_FragColor.a;
}`;

/** Discs of the two longer axes, as far as a Gaussian hides a third of the light; positions are z up. */
const SHADOW = `
uniform highp sampler2D positions;
uniform highp sampler2D orientations;
uniform highp sampler2D scales;
vec3 turned(vec4 q, vec3 v) {
  return v + 2.0 * cross(q.xyz, cross(q.xyz, v) + q.w * v);
}
void main() {
  ivec2 cell = ivec2(gl_InstanceID % 1024, gl_InstanceID / 1024);
  vec4 place = texelFetch(positions, cell, 0);
  vec3 s = texelFetch(scales, cell, 0).xyz;
  vec4 q = texelFetch(orientations, cell, 0);
  vec3 a = vec3(s.x, 0.0, 0.0), b = vec3(0.0, s.y, 0.0), c = vec3(0.0, 0.0, s.z);
  if (s.x <= s.y && s.x <= s.z) a = c;
  else if (s.y <= s.z) b = c;
  float reach = sqrt(max(2.0 * log(3.0 * place.w), 0.0));
  vec3 world = place.xyz + turned(q, reach * (position.x * a + position.y * b));
  gl_Position = projectionMatrix * modelViewMatrix * vec4(world.x, world.z, -world.y, 1.0);
}`;

const toZUp = (v) => [v.x, -v.z, v.y];
const fromZUp = ([x, y, z]) => new THREE.Vector3(x, z, -y);

/** Return a scene's lamps as records, in the axes of an object whose inverse matrix and size are given. */
export function lampsOf(scene, toObject, size) {
  const lamps = [], place = new THREE.Vector3(), target = new THREE.Vector3();
  scene.traverseVisible((light) => {
    if (!light.isLight || !(light.intensity > 0)) return;
    const power = light.color.toArray().map((value) => value * light.intensity), casts_shadows = light.castShadow;
    place.setFromMatrixPosition(light.matrixWorld).applyMatrix4(toObject);
    if (light.target) target.setFromMatrixPosition(light.target.matrixWorld).applyMatrix4(toObject).sub(place);
    const lamp = {position: toZUp(place), intensity: power.map((value) => value / size ** 2), radius: (light.userData.radius ?? 0) / size, casts_shadows};
    const direction = toZUp(target);
    if (light.isDirectionalLight) {
      lamps.push({type: "directional", direction, irradiance: power, angular_diameter: light.userData.angularDiameter ?? 0.53, casts_shadows});
    } else if (light.isSpotLight) {
      const outer = Math.min(light.angle * 180 / Math.PI, 89);
      lamps.push({type: "spot", ...lamp, direction, outer_angle: outer, inner_angle: Math.min(outer * (1 - light.penumbra), outer - 0.05)});
    } else if (light.isPointLight) lamps.push({type: "point", ...lamp});
  });
  return lamps;
}

/** Return an equirectangular texture of floats as an `Environment`. */
async function environmentOf({image: {data, width, height}, type, flipY}) {
  const read = type === THREE.HalfFloatType ? THREE.DataUtils.fromHalfFloat : (value) => value;
  const parts = data.length / (width * height), radiance = new Float32Array(3 * width * height);
  for (let i = 0; i < width * height; i++) {
    const row = Math.floor(i / width), from = (flipY ? row : height - 1 - row) * width + i % width;
    for (let c = 0; c < 3; c++) radiance[3 * i + c] = Math.max(read(data[parts * from + c]), 0);
  }
  return Environment.of({height, radiance});
}

/** What `RelightObject` needs of a `WebGLRenderer`. */
class WebGLHost {
  constructor(renderer) {
    Object.assign(this, {renderer, canvas: renderer.domElement, options: {backend: "webgl2", context: renderer.getContext()}, isTopFirst: false});
  }

  /** Return the material that shows Gaussians on a triangle over the whole view. */
  display() {
    const textures = Object.fromEntries(["lit", "depths"].map((name) => [name, {value: new THREE.ExternalTexture()}]));
    this.shown = {...textures, projection: {value: new THREE.Matrix4()}, unit: {value: 1}, rows: {value: 1}};
    return new THREE.ShaderMaterial({uniforms: this.shown, vertexShader: "void main() { gl_Position = vec4(position, 1.0); }", fragmentShader: DISPLAY,
      transparent: true, premultipliedAlpha: true, depthWrite: true});
  }

  /** Show what was drawn last, through a camera, in an object of a size; without a camera, nothing. */
  show(relight, camera, size) {
    const {lit, depths, projection, unit, rows} = this.shown;
    lit.value.sourceTexture = camera ? relight.texture("lit").handle : null; // null is clear
    if (!camera) return;
    depths.value.sourceTexture = relight.texture("sums2").handle;
    projection.value.copy(camera.projectionMatrix);
    unit.value = size;
    rows.value = relight.texture("lit").height;
  }

  /** Return the material of a disc for each Gaussian, and the one by which three's shadow maps see it. */
  caster(relight) {
    const uniforms = Object.fromEntries(["positions", "orientations", "scales"].map((name) => [name, {value: new THREE.ExternalTexture()}]));
    const shadow = new THREE.ShaderMaterial({uniforms, side: THREE.DoubleSide, glslVersion: THREE.GLSL3, vertexShader: SHADOW,
      fragmentShader: "out vec4 shown;\nvoid main() { shown = vec4(1.0); }"});
    this.cast = () => { for (const [name, {value}] of Object.entries(uniforms)) value.sourceTexture = relight.texture(name).handle; };
    return {material: new THREE.MeshBasicMaterial({colorWrite: false, depthWrite: false, shadowSide: THREE.DoubleSide}), shadow};
  }

  /** Return the material that writes how far meshes are from a camera. */
  depthOnly() {
    return new THREE.ShaderMaterial({side: THREE.DoubleSide, blending: THREE.NoBlending,
      vertexShader: "varying float depth;\nvoid main() { vec4 p = modelViewMatrix * vec4(position, 1.0); depth = -p.z; gl_Position = projectionMatrix * p; }",
      fragmentShader: "varying float depth;\nvoid main() { gl_FragColor = vec4(depth, 0.0, 0.0, 1.0); }"});
  }

  /** Return a target's texture as the renderer of Gaussians reads it. */
  read({texture, width, height}) {
    return {handle: this.renderer.properties.get(texture).__webglTexture, target: this.options.context.TEXTURE_2D, width, height};
  }

  /** Tell the renderer that others have changed the state of its context. */
  settle() {
    this.renderer.resetState();
  }
}

/** Gaussians of a take in a scene. Events: change (draw again), and those of `Relight` through `relight`. */
export class RelightObject extends THREE.Mesh {
  /** Return an object that a `WebGLRenderer` or a `WebGPURenderer` draws; `shadowMapSize` is the side of the lamps' maps [texel]. */
  static async create(renderer, take, {shadowMapSize = 1024} = {}) {
    const host = renderer.isWebGPURenderer ? await (await import("./three-webgpu.js")).WebGPUHost.of(renderer) : new WebGLHost(renderer);
    const relight = await Relight.create(host.canvas, {...host.options, shadowMapSize});
    const geometry = Object.assign(new THREE.InstancedBufferGeometry(), {instanceCount: 1});
    geometry.setAttribute("position", new THREE.Float32BufferAttribute([-1, -1, 0, 3, -1, 0, -1, 3, 0], 3));
    const object = Object.assign(new RelightObject(geometry, host.display(relight)), {relight, frustumCulled: false, castShadow: true, receiveShadow: true});
    object.#host = host;
    object.onBeforeShadow = () => { geometry.instanceCount = 0; }; // its child casts the shadow
    object.onAfterShadow = () => { geometry.instanceCount = 1; };
    await relight.open(take);
    host.settle();
    object.#addCaster(take.manifest.count);
    relight.meshDepth = (_, k) => object.#meshDepths[k];
    for (const type of ["sorted", "restored", "resumed"]) relight.addEventListener(type, () => object.dispatchEvent({type: "change"}));
    return object;
  }

  #host; #caster; #meshDepths = []; #targets = []; #depthMaterial; #casters = ""; #lamps = ""; #environment = null; #isBusy = false;

  /** Moment that is shown [s]. */
  get time() {
    return this.relight.time;
  }

  set time(seconds) {
    this.relight.time = seconds;
  }

  /** A child that only shadow maps see: an octagon a Gaussian. */
  #addCaster(count) {
    const geometry = Object.assign(new THREE.InstancedBufferGeometry().copy(new THREE.CircleGeometry(1, 8)), {instanceCount: 0});
    const {material, shadow} = this.#host.caster(this.relight), caster = new THREE.Mesh(geometry, material);
    Object.assign(caster, {castShadow: true, frustumCulled: false, customDepthMaterial: shadow, customDistanceMaterial: shadow});
    caster.onBeforeShadow = () => {
      const isDrawn = this.castShadow && this.relight.texture("lit");
      geometry.instanceCount = isDrawn ? count : 0;
      if (isDrawn) this.#host.cast();
    };
    caster.onAfterShadow = () => { geometry.instanceCount = 0; };
    this.#caster = caster;
    this.add(caster);
  }

  /** Bring the scene's lamps and environment, and the camera's view; called by the renderer. */
  onBeforeRender(renderer, scene, camera) {
    if (this.#isBusy) return;
    this.#isBusy = true;
    const target = renderer.getRenderTarget(), face = renderer.getActiveCubeFace(), level = renderer.getActiveMipmapLevel();
    try {
      const size = new THREE.Vector3().setFromMatrixScale(this.matrixWorld).x, toObject = this.matrixWorld.clone().invert();
      this.#light(scene, toObject, size);
      this.#drawMeshDepths(renderer, scene);
      const {width, height} = target ?? renderer.getDrawingBufferSize(new THREE.Vector2());
      const view = this.#view(camera, toObject, width, height);
      this.#host.show(this.relight, this.relight.shade(view) ? camera : null, size);
    } finally {
      this.#host.settle();
      renderer.setRenderTarget(target, face, level);
      this.#isBusy = false;
    }
  }

  #view(camera, toObject, width, height) {
    const pose = toObject.clone().multiply(camera.matrixWorld), p = camera.projectionMatrix.elements;
    const axes = [0, 1, 2].map((k) => new THREE.Vector3().setFromMatrixColumn(pose, k).normalize());
    return {
      position: toZUp(new THREE.Vector3().setFromMatrixPosition(pose)),
      worldToCamera: [toZUp(axes[0]), toZUp(axes[1].negate()), toZUp(axes[2].negate())].flat(),
      focal: [p[0] * width / 2, p[5] * height / 2], center: [width / 2 * (1 - p[8]), height / 2 * (1 + p[9])],
      width, height, name: camera.uuid,
    };
  }

  #light(scene, toObject, size) {
    const lamps = lampsOf(scene, toObject, size), key = JSON.stringify(lamps);
    if (key !== this.#lamps) this.relight.lights = lamps;
    this.#lamps = key;
    const sky = scene.environment;
    this.relight.environmentGain = scene.environmentIntensity;
    this.relight.rotation = scene.environmentRotation.y * 180 / Math.PI;
    if (sky === this.#environment) return;
    this.#environment = sky;
    const made = !sky ? Environment.constant() : sky.isDataTexture && sky.mapping === THREE.EquirectangularReflectionMapping ? environmentOf(sky) : null;
    made?.then((environment) => {
      if (sky === this.#environment) this.relight.environment = environment;
      this.dispatchEvent({type: "change"});
    });
  }

  /** Draw depths of what casts shadows for the lamps of the Gaussians, if anything has moved. */
  #drawMeshDepths(renderer, scene) {
    const views = this.receiveShadow ? this.relight.shadowViews : [], casters = [];
    scene.traverseVisible((mesh) => { if (mesh.isMesh && mesh.castShadow && mesh !== this && mesh !== this.#caster) casters.push(mesh); });
    const key = JSON.stringify([views.map(({position, forward, focal}) => [position, forward, focal]), this.matrixWorld, casters.map((mesh) => [mesh.id, mesh.matrixWorld])]);
    if (key === this.#casters) return;
    this.#casters = key;
    this.relight.redrawShadows();
    this.#depthMaterial ??= this.#host.depthOnly();
    while (this.#targets.length > views.length) this.#targets.pop().dispose();
    const {autoClear} = renderer, {autoUpdate} = renderer.shadowMap, {overrideMaterial, background} = scene, color = renderer.getClearColor(new THREE.Color()), alpha = renderer.getClearAlpha();
    Object.assign(scene, {overrideMaterial: this.#depthMaterial, background: null});
    renderer.shadowMap.autoUpdate = false;
    renderer.autoClear = true;
    renderer.setClearColor(0, 0);
    this.visible = false;
    for (const mesh of casters) mesh.layers.enable(31);
    views.forEach((view, k) => {
      this.#targets[k] ??= new (this.#host.isTopFirst ? THREE.RenderTarget : THREE.WebGLRenderTarget)(view.width, view.height, {type: THREE.FloatType, minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter});
      renderer.setRenderTarget(this.#targets[k]);
      renderer.render(scene, this.#lampCamera(view, renderer));
      this.#meshDepths[k] = this.#host.read(this.#targets[k]);
    });
    for (const mesh of casters) mesh.layers.disable(31);
    this.visible = true;
    renderer.setClearColor(color, alpha);
    renderer.shadowMap.autoUpdate = autoUpdate;
    renderer.autoClear = autoClear;
    Object.assign(scene, {overrideMaterial, background});
  }

  /** Return a camera that sees what a shadow map sees, its top row first. */
  #lampCamera({position, right, down, forward, focal, width}, {coordinateSystem = THREE.WebGLCoordinateSystem}) {
    const camera = new THREE.Camera(), far = 2 * Math.hypot(...position) + 1000, near = Math.max(far * 1e-6, 0.01);
    const pose = new THREE.Matrix4().makeBasis(fromZUp(right), fromZUp(down).negate(), fromZUp(forward).negate()).setPosition(fromZUp(position));
    Object.assign(camera, {coordinateSystem});
    camera.layers.set(31);
    camera.matrixAutoUpdate = camera.matrixWorldAutoUpdate = false;
    camera.matrixWorld.multiplyMatrices(this.matrixWorld, pose);
    camera.matrixWorldInverse.copy(camera.matrixWorld).invert();
    const f = 2 * focal[0] / width, depth = this.#host.isTopFirst ? [far, far * near] : [far + near, 2 * far * near]; // 0 to 1, or -1 to 1
    camera.projectionMatrix.set(f, 0, 0, 0, 0, this.#host.isTopFirst ? f : -f, 0, 0, 0, 0, -depth[0] / (far - near), -depth[1] / (far - near), 0, 0, -1, 0);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    return camera;
  }

  /** Resolves when the moment's Gaussians are here, and what was drawn last is in order: draw again then. */
  async ready() {
    await this.relight.ready();
  }

  /** Give back all memory. */
  dispose() {
    this.relight.dispose();
    for (const target of this.#targets) target.dispose();
    const {geometry, material, customDepthMaterial} = this.#caster;
    for (const each of [this.geometry, this.material, this.#depthMaterial, geometry, material, customDepthMaterial]) each?.dispose();
  }
}
