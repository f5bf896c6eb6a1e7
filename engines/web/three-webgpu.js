/** What `RelightObject` of three.js needs of a `WebGPURenderer`: materials of nodes, and textures on the device that both share. */

import {Fn, cross, float, instanceIndex, int, ivec2, log, max, positionGeometry, positionView, screenCoordinate, select, sqrt, texture, uniform,
  vec3, vec4} from "three/tsl";
import * as THREE from "three/webgpu";
import {GpuError} from "./gpu.js";

const ROW = 1024, SHADOWED = ["positions", "orientations", "scales"];

/** A host of `RelightObject`, as three.js describes one. */
export class WebGPUHost {
  #textures = new WeakMap();

  /** Return a host; the renderer must draw by WebGPU. */
  static async of(renderer) {
    await renderer.init();
    const {device} = renderer.backend;
    if (!device) throw new GpuError("WebGPURenderer must draw by WebGPU, got its other backend. Use a WebGLRenderer.");
    return Object.assign(new WebGPUHost(), {renderer, canvas: null, options: {backend: "webgpu", device}, isTopFirst: true});
  }

  /** Return a node whose texture `bind` may change; nodes that show the same one at first must not become one. */
  #node(relight) {
    const first = Object.assign(new THREE.ExternalTexture(relight.texture("nothing").handle), {type: THREE.FloatType});
    return Object.assign(texture(first), {mergeable: false});
  }

  /** Let a node read a texture of the renderer of Gaussians. */
  #bind(node, {handle}) {
    if (!this.#textures.has(handle)) this.#textures.set(handle, Object.assign(new THREE.ExternalTexture(handle), {type: THREE.FloatType}));
    node.value = this.#textures.get(handle);
  }

  /** Return the material that shows Gaussians on a triangle over the whole view. */
  display(relight) {
    const [lit, depths] = [0, 1].map(() => this.#node(relight)), cell = ivec2(screenCoordinate), seen = lit.load(cell), sums = depths.load(cell);
    const projection = uniform(new THREE.Matrix4()), unit = uniform(1);
    const clip = projection.mul(vec4(0, 0, sums.z.div(sums.w).mul(unit).negate(), 1));
    this.shown = {lit, depths, projection, unit};
    return Object.assign(new THREE.MeshBasicNodeMaterial({transparent: true, premultipliedAlpha: true, depthWrite: true, fog: false}), {
      vertexNode: vec4(positionGeometry, 1), colorNode: seen.rgb.div(seen.a), opacityNode: seen.a,
      maskNode: seen.a.greaterThanEqual(1 / 255), depthNode: clip.z.div(clip.w).clamp(0, 1),
    });
  }

  /** Show what was drawn last, through a camera, in an object of a size; without a camera, nothing. */
  show(relight, camera, size) {
    const {lit, depths, projection, unit} = this.shown, nothing = relight.texture("nothing");
    this.#bind(lit, camera ? relight.texture("lit") : nothing);
    this.#bind(depths, camera ? relight.texture("sums2") : nothing);
    if (camera) projection.value.copy(camera.projectionMatrix);
    unit.value = size;
  }

  /** Return the material of a disc for each Gaussian, as three's shadow maps see it, and what else has to be disposed of. */
  caster(relight) {
    const nodes = SHADOWED.map(() => this.#node(relight)), index = int(instanceIndex), cell = ivec2(index.mod(ROW), index.div(ROW));
    const [place, q, scales] = nodes.map((node) => node.load(cell));
    const turned = (v) => v.add(cross(q.xyz, cross(q.xyz, v).add(v.mul(q.w))).mul(2));
    const position = Fn(() => {
      const s = scales.xyz.toVar(), isThinX = s.x.lessThanEqual(s.y).and(s.x.lessThanEqual(s.z)), isThinY = s.y.lessThanEqual(s.z);
      const x = vec3(s.x, 0, 0), y = vec3(0, s.y, 0), z = vec3(0, 0, s.z);
      const a = select(isThinX, z, x), b = select(isThinX.not().and(isThinY), z, y);
      const reach = sqrt(max(log(place.w.mul(3)).mul(2), float(0)));
      const world = place.xyz.add(turned(a.mul(positionGeometry.x).add(b.mul(positionGeometry.y)).mul(reach)));
      return vec3(world.x, world.z, world.y.negate());
    })();
    this.cast = () => SHADOWED.forEach((name, k) => this.#bind(nodes[k], relight.texture(name)));
    return {material: Object.assign(new THREE.MeshBasicNodeMaterial({colorWrite: false, depthWrite: false, shadowSide: THREE.DoubleSide}),
      {castShadowPositionNode: position})};
  }

  /** Return the material that writes how far meshes are from a camera. */
  depthOnly() {
    return Object.assign(new THREE.MeshBasicNodeMaterial({side: THREE.DoubleSide, blending: THREE.NoBlending, fog: false}),
      {colorNode: vec4(positionView.z.negate(), 0, 0, 1)});
  }

  /** Return a target's texture as the renderer of Gaussians reads it. */
  read({texture: drawn, width, height}) {
    const handle = this.renderer.backend.get(drawn).texture;
    return {handle, view: handle.createView(), width, height};
  }

  /** Leave the renderer as it was; nothing is to be done, for passes share a device, not its state. */
  settle() {}
}
