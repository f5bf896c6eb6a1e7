/**
 * The renderer: draws a take as Gaussians whose materials are lit, under any environment and lamps.
 *
 *     const relight = await Relight.create(canvas);
 *     await relight.open(await Take.open("person.b4d"));
 *     relight.environment = await Environment.load("studio.hdr");
 *     await relight.render(camera);
 *
 * Planes of the container stay on the GPU, which evaluates frames and the blends between them. The world is beam_warp's:
 * metres, z up; cameras are right, down, forward. docs/engines/web.md describes all of it.
 */

import {Environment} from "./environment.js";
import {GpuError, WebGL2, WebGPU} from "./gpu.js";
import {checkedLights, depthRow, distantView, lampNumbers, mapNumbers, shadowViews} from "./lights.js";
import {Segments} from "./segments.js";
import * as passes from "./shaders.js";
import {GLSL, GLSL_FETCHING, WGSL, WGSL_FETCHING} from "./shading.js";
import {sorter} from "./sorting.js";

const {ROW, ORDER, RADIANCE, CHANNELS, BINS, SEARCHES} = passes;
const isStored = (name) => name in ORDER || name in RADIANCE;
const MAX_LAYERS = 256, LAYER_ROWS = 2048, KEPT_BYTES = 2 ** 28, THICKEST = 0.02, REGION_SIDE = 256;
/** No shadow maps: of lamps, or of regions of the environment. */
const NO_MAPS = {key: null, views: [], orders: [], drawn: true};
const SHADOW_FILTERS = [0.1, 0.01, 1, 0];
/** What stands for arrays that a container lacks. */
const DEFAULTS = {base_color: [0.5, 0.5, 0.5], roughness: [0.5], ambient_occlusion: [1]};
const TRANSFORMS = ["standard", "aces", "agx", "neutral"];

/** Something that is asked of the renderer breaks its contract; the message says what. */
export class RelightError extends Error {}

function require(condition, contract, got) {
  if (!condition) throw new RelightError(`${contract}, got ${String(JSON.stringify(got)).slice(0, 80)}.`);
}

const numbers = (list, count) => list?.length === count && Array.from(list).every(Number.isFinite);

/** A camera as the passes take it. */
function viewOf(camera) {
  const {position, worldToCamera: m, focal, center, width, height} = camera;
  require(numbers(position, 3) && numbers(m, 9), "camera must have a position and nine numbers worldToCamera", [position, m]);
  require(numbers(focal, 2) && numbers(center, 2) && focal[0] > 0 && focal[1] > 0, "camera must have focal and center [pixel]", [focal, center]);
  require([width, height].every((side) => Number.isInteger(side) && side > 0), "camera must have a width and height [pixel]", [width, height]);
  const rows = [0, 3, 6].map((k) => Array.from(m).slice(k, k + 3));
  return {position: Array.from(position), right: rows[0], down: rows[1], forward: rows[2], focal, center, width, height};
}

const cameraNumbers = (view, count) => ({
  right: view.right, down: view.down, forward: view.forward, eye: view.position,
  lens: [...view.focal, ...view.center], image: [view.width, view.height, 0, count],
});

/** A renderer of one canvas. Events: sorted, stalled, resumed, lost, restored, error. */
export class Relight extends EventTarget {
  #programs; #textures = {}; #sorter; #segments = null; #sortTime = 0;
  #take = null; #time = 0; #evaluated = null; #views = new Map(); #maps = {lamps: NO_MAPS, regions: NO_MAPS}; #casters = null;
  #environment = null; #lights = []; #versions = {lights: 0, environment: 0}; #sorting = null; #isDisposed = false; #isLost = false; #isOwn = true;

  /**
   * Return a renderer.
   * @param {HTMLCanvasElement|OffscreenCanvas|null} canvas What is drawn on; null to draw pictures that `read` returns.
   * @param {{backend?: "webgpu"|"webgl2", context?: WebGL2RenderingContext, device?: GPUDevice, shadowMapSize?: number,
   *     segmentBytes?: number}} [options] By default WebGPU if there is any; a context or a device of another renderer, to
   *     share textures with it; how many bytes of segments are kept on the GPU, though never fewer than three segments.
   */
  static async create(canvas, {backend, context = null, device = null, shadowMapSize = 1024, segmentBytes = KEPT_BYTES} = {}) {
    require([undefined, "webgpu", "webgl2"].includes(backend), "backend must be webgpu or webgl2", backend);
    require(Number.isInteger(shadowMapSize) && shadowMapSize >= 16 && shadowMapSize <= 8192, "shadowMapSize must be in [16, 8192]", shadowMapSize);
    require(segmentBytes >= 0, "segmentBytes must be at least 0", segmentBytes);
    const relight = Object.assign(new Relight(), {canvas, shadowMapSize, segmentBytes, rotation: 0, environmentGain: 1, exposure: 0, viewTransform: "standard",
      channel: "relit", background: null, depthRange: null, casters: null, environmentShadows: 0});
    relight.#environment = await Environment.constant();
    relight.#isOwn = !device;
    await relight.#start(async () => {
      if (backend !== "webgl2" && !context) {
        try {
          return await WebGPU.create(canvas, device);
        } catch (error) {
          if (backend) throw error;
        }
      }
      return WebGL2.create(canvas, context);
    });
    return relight;
  }

  /** Take a GPU, and bring everything to it. */
  async #start(makeGpu) {
    this.gpu = await makeGpu();
    this.backend = this.gpu.name;
    const {blendFormat: format} = this.gpu, program = (spec) => this.gpu.program(spec);
    this.#programs = {
      geometry: program(passes.geometry), materials: program(passes.materials), normals: program(passes.normals), gbuffer: program(passes.gbuffer(format)),
      deferred: program(passes.deferred({glsl: GLSL + GLSL_FETCHING, wgsl: WGSL + WGSL_FETCHING})), display: program(passes.display({glsl: GLSL, wgsl: WGSL}, this.backend === "webgl2" && !!this.canvas)),
    };
    this.#textures = {nothing: this.#filled([0, 0, 0, 0]), noMap: this.gpu.texture({width: 1, height: 1, layers: 1, format: "rgba32float"})};
    this.#upload(this.#environment);
    this.gpu.onLost((message) => this.#lost(message), (message) => this.#tell("error", {message}));
  }

  /** Programs that only lamps need are made when there is the first one. */
  #lampPrograms() {
    if (this.#programs.depths) return;
    const program = (spec) => this.gpu.program(spec), {blendFormat} = this.gpu;
    Object.assign(this.#programs, {
      depths: program(passes.depths(blendFormat)), bins: program(passes.bins(true)), fineBins: program(passes.bins(false)),
      pick: program(passes.pick(true)), finePick: program(passes.pick(false)), median: program(passes.median(blendFormat)), texels: program(passes.texels),
    });
  }

  /** The same for shadows of the environment. */
  #regionPrograms() {
    if (this.#programs.arrive) return;
    this.#lampPrograms();
    Object.assign(this.#programs, {arrive: this.gpu.program(passes.arrive({glsl: GLSL + GLSL_FETCHING, wgsl: WGSL + WGSL_FETCHING})),
      gbufferArriving: this.gpu.program(passes.gbuffer(this.gpu.blendFormat, true))});
  }

  #filled(texel) {
    const texture = this.gpu.texture({width: 1, height: 1, format: "rgba32float"});
    this.gpu.write(texture, new Float32Array(texel));
    return texture;
  }

  /** Return a texture that is made anew only if its size, number of layers or format changes. */
  #texture(name, width, height, format, layers = 0) {
    const old = this.#textures[name];
    if (old && old.width === width && old.height === height && old.layers === layers && old.format === format) return old;
    this.gpu.destroy(old);
    return this.#textures[name] = this.gpu.texture({width, height, layers, format});
  }

  #tell(type, detail) {
    this.dispatchEvent(new CustomEvent(type, {detail}));
  }

  // ---- What is lost and comes back

  #lost(message) {
    if (this.#isDisposed || this.#isLost) return;
    this.#isLost = true;
    this.#tell("lost", {message});
    const again = async () => {
      try {
        await this.#start(() => this.backend === "webgpu" ? WebGPU.create(this.canvas) : WebGL2.create(this.canvas, this.gpu.gl));
        const take = this.#take;
        if (take) await this.open(take);
        this.#isLost = false;
        this.#tell("restored", {backend: this.backend});
      } catch (error) {
        this.#tell("error", {error, message: `the GPU must come back, got ${error.message}`});
      }
    };
    if (!this.#isOwn) return; // whoever gave the device has to give another one
    if (this.backend === "webgpu") again();
    else this.gpu.gl.canvas.addEventListener("webglcontextrestored", again, {once: true});
  }

  /** Give back all memory; the renderer cannot be used any more. */
  dispose() {
    this.#isDisposed = true;
    this.#segments?.end();
    this.#sorter?.end();
    this.gpu.dispose();
    this.#take = null;
  }

  // ---- The take

  /** Show a take of b4d.js from now on; resolves when its static block is on the GPU. */
  async open(take) {
    const count = take.manifest.count, rows = Math.max(Math.ceil(count / ROW), 1);
    require(rows <= this.gpu.maxTextureSide, `count must be at most ${this.gpu.maxTextureSide * ROW} on this GPU`, count);
    this.#close();
    this.#take = take;
    this.#sorter ??= sorter();
    this.rows = rows;
    const stored = this.#store(Object.entries(take.raw).filter(([name]) => isStored(name)).flatMap(([name, values]) =>
      Array.from({length: values.length / Math.max(count, 1)}, (_, c) => [`${name}${c}`, values.subarray(c * count, (c + 1) * count)])), "float");
    for (const write of stored.late.values()) write();
    this.#textures.still = stored.texture;
    this.still = stored.places;
    for (const name of ["positions", "orientations", "scales", "colors", "normals"]) this.#texture(name, ROW, rows, "rgba32float");
    this.thickness = middleScale(take.still.scales, count);
    await this.#sorter.ask({still: take.raw.positions, opacities: take.still.opacities, count, row: ROW});
    if (take !== this.#take) return;
    this.#segments = new Segments(take, {most: this.segmentBytes, store: (...given) => this.#bring(...given), free: (segment) => this.#free(segment),
      tell: (type, detail) => this.#tell(type, detail)});
  }

  #close() {
    this.#segments?.end();
    this.#segments = null;
    for (const view of this.#views.values()) this.gpu.destroy(view.order);
    this.#views.clear();
    for (const name of ["still", "none", "noInts"]) this.gpu.destroy(this.#textures[name]);
    this.#textures.none = this.gpu.texture({width: 1, height: 1, layers: 1, format: "r32float"});
    this.#textures.noInts = this.gpu.texture({width: 1, height: 1, layers: 1, format: "r8sint"});
    for (const {orders} of Object.values(this.#maps)) for (const order of orders) this.gpu.destroy(order);
    this.#maps = {lamps: NO_MAPS, regions: NO_MAPS};
    this.#evaluated = this.#casters = null;
  }

  #free({summed, plain, number, late}) {
    late.clear();
    this.gpu.destroy(summed);
    this.gpu.destroy(plain);
    this.#sorter.ask({drop: number});
  }

  /** Make room for planes in one texture: rows of Gaussians, planes below each other, in layers. `late` says how each is written. */
  #store(planes, kind) {
    if (!planes.length) return {texture: null, places: {}, late: new Map()};
    const rows = this.rows, format = kind === "float" ? "r32float" : "r8sint", stack = Math.max(Math.floor(LAYER_ROWS / rows), 1);
    const layers = Math.ceil(planes.length / stack), height = Math.min(stack, planes.length) * rows;
    require(layers <= MAX_LAYERS, `a segment must have at most ${MAX_LAYERS * stack} planes`, planes.length);
    const texture = this.gpu.texture({width: ROW, height, layers, format}), places = {}, late = new Map();
    const padded = new (kind === "float" ? Float32Array : Int8Array)(ROW * rows);
    planes.forEach(([name, values], k) => {
      const layer = Math.floor(k / stack), y = (k % stack) * rows;
      places[name] = [y, layer];
      late.set(name, () => {
        padded.set(values);
        this.gpu.write(texture, padded, {layer, y, height: rows});
      });
    });
    return {texture, places, late};
  }

  /** Length of the take [s]. */
  get duration() {
    return this.#take ? this.#take.manifest.frames / this.#take.manifest.rate : 0;
  }

  /** Moment that is shown [s]; the take holds its first and last frame outside of its length. */
  get time() {
    return this.#time;
  }

  set time(seconds) {
    require(Number.isFinite(seconds), "time must be a number of seconds", seconds);
    this.#time = seconds;
  }

  /** Return the segment of a moment, the frame in it, and the share of the next one. */
  #place() {
    const {manifest} = this.#take, blends = manifest.topology === "constant";
    const at = Math.min(Math.max(this.#time * manifest.rate, 0), manifest.frames - 1), frame = Math.floor(at);
    const number = manifest.segments.findIndex(({first, frames}) => frame < first + frames);
    const {first, frames} = manifest.segments[number], local = frame - first;
    let share = blends ? at - frame : 0;
    if (local === frames - 1 && share) { // blends end at the last frame of a segment
      if (share >= 0.5) return {number: number + 1, local: 0, share: 0};
      share = 0;
    }
    return {number, local, share};
  }

  /** Bring a segment to the GPU, and what it says of positions to the sorter: first what all frames need, the rest when a frame needs it, or soon. */
  async #bring(number, entry, tracks) {
    const positions = (tracks.positions ?? [[], [], []]).map(({planes = []}) => planes), isOctets = (values) => values instanceof Int8Array;
    const told = this.#sorter.ask({segment: number, planes: positions.map((planes) => planes.map((values) => isOctets(values) ? null : values))});
    const named = Object.entries(tracks).filter(([name]) => isStored(name)).flatMap(([name, components]) =>
      components.flatMap(({planes}, c) => planes.map((values, k) => [`${name}${c}/${k}`, values])));
    const summed = this.#store(named.filter(([, values]) => values instanceof Float32Array), "float");
    const plain = this.#store(named.filter(([, values]) => isOctets(values)), "int"), {late} = plain;
    for (const write of summed.late.values()) write();
    positions.forEach((planes, c) => planes.forEach((values, k) => {
      const name = `positions${c}/${k}`, write = late.get(name);
      if (write) late.set(name, () => { write(); this.#sorter.ask({segment: number, plane: [c, k, values.slice()]}); });
    }));
    const weights = mapped(tracks, (components) => components.map(({columns, weights: all}) => ({columns, weights: all})));
    await told;
    this.#bringRest(late);
    return {number, entry, weights, late, summed: summed.texture, plain: plain.texture, summedPlaces: summed.places, plainPlaces: plain.places,
      bytes: 4 * texels(summed.texture) + texels(plain.texture)};
  }

  /** Write planes that no frame has needed yet, a few at a time, so that pictures are drawn meanwhile; an order of depth comes first. */
  async #bringRest(late) {
    for (const [name, write] of late) {
      if (late.size % 8 === 0) await new Promise((resolve) => setTimeout(resolve)).then(() => this.#sorting);
      if (late.delete(name)) write();
    }
  }

  /** Moment that is shown [s]: that of the nearest frame at hand, while the wanted one is on its way; null before the first. */
  get shownTime() {
    if (!this.#evaluated) return null;
    const {segments, rate} = this.#take.manifest, {number, local, share} = this.#evaluated.place;
    return (segments[number].first + local + share) / rate;
  }

  /** Bytes of segments that are kept on the GPU. */
  get keptBytes() {
    return this.#segments?.bytes ?? 0;
  }

  /** How long the last segment took to be fetched, unpacked and brought to the GPU, and the last order of depth to be found [ms]. */
  get timings() {
    return {...this.#segments?.timings, sort: this.#sortTime};
  }

  /** Return the sums that give a frame: offsets and terms of every component of arrays, whose places are given. */
  #sums({number, local, share}, arrays = ORDER, components = passes.COMPONENTS) {
    const segment = this.#segments.get(number), heads = new Float32Array(4 * components), terms = [], forSorter = {heads: [0, 0, 0], terms: [[], [], []]};
    for (const [name, start] of Object.entries(arrays)) {
      const size = {opacities: 1, roughness: 1, ambient_occlusion: 1}[name] ?? 3, tracks = segment.weights[name];
      for (let c = 0; c < size; c++) {
        const first = terms.length, place = this.still[`${name}${c}`];
        let offset = place || tracks ? 0 : DEFAULTS[name]?.[c] ?? 0;
        if (place) terms.push([0, ...place, 1]);
        if (tracks) {
          const {columns, weights} = tracks[c], at = local * columns, next = share ? at + columns : at;
          for (let k = 0; k < columns; k++) {
            const weight = (1 - share) * weights[at + k] + share * weights[next + k];
            if (k === 0) offset = weight;
            else if (weight) {
              const key = `${name}${c}/${k - 1}`, isSummed = key in segment.summedPlaces;
              const write = segment.late.get(key);
              if (write && segment.late.delete(key)) write();
              terms.push([isSummed ? 1 : 2, ...(isSummed ? segment.summedPlaces : segment.plainPlaces)[key], weight]);
              if (name === "positions") forSorter.terms[c].push([k - 1, weight]);
            }
          }
          if (name === "positions") forSorter.heads[c] = offset;
        }
        heads.set([offset, first, terms.length - first, 0], 4 * (start + c));
      }
    }
    require(terms.length <= passes.TERMS, `a frame must be a sum of at most ${passes.TERMS} planes`, terms.length);
    return {heads, terms: terms.flat(), at: {frame: `${number}:${local}:${share}`, segment: number, ...forSorter}};
  }

  /** Return the wanted place; if its segment is not here, the nearest one that is (before it if it is lost), unless a nearer one is shown. */
  #placeHere() {
    const place = this.#place(), shown = this.#evaluated?.place, {segments} = this.#take.manifest;
    this.#segments.want(place.number);
    if (this.#segments.has(place.number)) return place;
    const frame = segments[place.number].first + place.local, near = this.#segments.nearest(frame, this.#segments.hasFailed(place.number));
    return near && !(shown && Math.abs(segments[shown.number].first + shown.local - frame) <= near.distance) ? near : null;
  }

  /** Evaluate the wanted frame, or the nearest one that is here. */
  #advance() {
    const place = this.#segments && this.#placeHere();
    if (!place) return;
    const segment = this.#segments.get(place.number), key = `${place.number}:${place.local}:${place.share}`;
    if (this.#evaluated?.key === key) return;
    this.#segments.shown = place.number;
    const {heads, terms, at} = this.#sums(place), t = this.#textures;
    const textures = {still: t.still, summed: segment.summed ?? t.none, plain: segment.plain ?? t.noInts}, uniforms = {heads, terms};
    for (const [name, targets] of [["geometry", [t.positions, t.orientations]], ["materials", [t.scales, t.colors]], ["normals", [t.normals]]]) {
      this.gpu.draw(this.#programs[name], {targets, uniforms, textures});
    }
    this.#evaluated = {key, at, place, textures};
  }

  // ---- Light

  /** Light from all around, an `Environment`; null for darkness. */
  get environment() {
    return this.#environment;
  }

  set environment(environment) {
    require(environment instanceof Environment, "environment must be an Environment", environment);
    this.#environment = environment;
    this.#versions.environment++;
    if (!this.#isLost) this.#upload(environment);
  }

  #upload({maps, albedo}) {
    const rgba = (values, from, size) => {
      const out = new Float32Array(4 * size);
      for (let i = 0; i < size; i++) for (let c = 0; c < from; c++) out[4 * i + c] = values[from * i + c];
      return out;
    };
    const width = 2 * Math.max(...maps.map(({height}) => height)), total = maps.reduce((sum, {height}) => sum + height, 0);
    const texture = this.#texture("environment", width, total, "rgba32float"), side = Math.sqrt(albedo.length / 2);
    this.levels = [];
    let y = 0;
    for (const {height, radiance} of maps) {
      this.gpu.write(texture, rgba(radiance, 3, 2 * height * height), {y, width: 2 * height, height});
      this.levels.push(height, y, 0, 0);
      y += height;
    }
    this.gpu.write(this.#texture("albedo", side, side, "rgba32float"), rgba(albedo, 2, side * side));
  }

  /** Lamps: objects of the JSON that `beam render --lights` reads. */
  get lights() {
    return this.#lights;
  }

  set lights(records) {
    const lights = checkedLights(records);
    require(lights.length <= passes.LAMPS, `lights must be at most ${passes.LAMPS}`, lights.length);
    this.#lights = lights;
    this.#versions.lights++;
  }

  // ---- Depth order

  /** Sort for a view, and for the lamps where their maps are old; one request at a time, the newest wins. */
  #sort(name, exact) {
    if (!this.#evaluated) return Promise.resolve();
    const wanted = () => {
      const view = this.#views.get(name), key = `${this.#evaluated.key}|${depthRow(view.camera)}`, maps = this.#mapKeys();
      return {view, key, maps, isOld: view.sorted !== key || Object.keys(maps).some((kind) => this.#isStale(kind, maps))};
    };
    if (this.#sorting) return exact ? this.#sorting.then(() => this.#sort(name, true)) : this.#sorting;
    const {view, key, maps, isOld} = wanted();
    if (!isOld) return Promise.resolve();
    this.#sorting = this.#ask(view, key, maps).catch((error) => {
      if (!this.#isDisposed && !this.#isLost) this.#tell("error", {error, message: error.message});
    }).finally(() => { this.#sorting = null; });
    return this.#sorting;
  }

  /** Return what shadow maps have to be of, by kind; null for none. */
  #mapKeys() {
    const {key} = this.#evaluated, {lights, environment} = this.#versions;
    return {lamps: this.#lights.length ? `${key}|${lights}|${this.shadowMapSize}` : null,
      regions: this.environmentShadows && this.channel === "relit" ? `${key}|${environment}|${this.rotation}|${this.environmentShadows}` : null};
  }

  #isStale(kind, keys) {
    return keys[kind] !== null && this.#maps[kind].key !== keys[kind];
  }

  /** Return the views of shadow maps, those of a lamp or a region together, and what else is known of them. */
  async #mapViews(kind) {
    if (kind === "lamps") {
      const views = this.#lights.map((light) => shadowViews(light, this.#casters, this.shadowMapSize));
      require(views.flat().length <= passes.MAPS, `shadow maps must be at most ${passes.MAPS}`, views.flat().length);
      return {views, lights: this.#lights};
    }
    const environment = this.#environment, angle = this.rotation * Math.PI / 180, regions = await environment.regions(this.environmentShadows);
    const turned = ([x, y, z, ...rest]) => [x * Math.cos(angle) - y * Math.sin(angle), x * Math.sin(angle) + y * Math.cos(angle), z, ...rest];
    return {views: regions.map(({direction, halfAngle}) => [distantView(turned(direction), halfAngle, this.#casters, REGION_SIDE)]), environment,
      moments: regions.flatMap(({moments}) => moments.flatMap(turned))};
  }

  /** Return the sphere around what is most of the take. */
  async #bulk(at) {
    const {bulk: {center: [x, y, z], radius}} = await this.#sorter.ask({at, bulk: true});
    return {center: [x, -z, y], radius};
  }

  async #ask(view, key, keys) {
    const {at} = this.#evaluated, take = this.#take, gpu = this.gpu, kinds = Object.keys(keys).filter((kind) => this.#isStale(kind, keys)), fresh = [];
    if (kinds.length) this.#casters = this.casters ?? await this.#bulk(at);
    for (const kind of kinds) fresh.push(await this.#mapViews(kind));
    const began = performance.now(), mapViews = fresh.flatMap(({views}) => views.flat());
    const {orders: [order, ...others]} = await this.#sorter.ask({at, views: [view.camera, ...mapViews].map(depthRow)});
    this.#sortTime = performance.now() - began;
    if (take !== this.#take || gpu !== this.gpu || this.#isLost || this.#isDisposed) return;
    view.order ??= this.gpu.texture({width: ROW, height: this.rows, format: "r32float"});
    this.gpu.write(view.order, order);
    view.sorted = key;
    kinds.forEach((kind, n) => {
      const old = this.#maps[kind].orders;
      const orders = others.splice(0, fresh[n].views.flat().length).map((numbersOf, k) => {
        const texture = old[k] ?? this.gpu.texture({width: ROW, height: this.rows, format: "r32float"});
        this.gpu.write(texture, numbersOf);
        return texture;
      });
      for (const texture of old.slice(orders.length)) this.gpu.destroy(texture);
      this.#maps[kind] = {...fresh[n], key: keys[kind], orders, drawn: false};
    });
    this.#tell("sorted", {key});
  }

  // ---- Drawing

  /** What splats are drawn with: uniforms and textures of a view. */
  #splats(view, order, filters) {
    const t = this.#textures;
    return {
      uniforms: {...cameraNumbers(view, this.#take.manifest.count), filters},
      textures: {order, positions: t.positions, orientations: t.orientations, scales: t.scales, colors: t.colors, normals: t.normals},
      instances: this.#take.manifest.count || null,
    };
  }

  /** Find median depths of a view, in ever smaller ranges of the order of splats: sums of depth times alpha, and of alpha. */
  #median(view, order, filters, name) {
    const {gpu} = this, p = this.#programs, {width, height} = view, splats = this.#splats(view, order, filters);
    const passing = this.#texture("passing", width, height, "rgba16float", BINS / 4), bins = [0, 1, 2, 3].map((k) => [passing, k]);
    const run = (program, targets, clear, uniforms, picked) =>
      gpu.draw(program, {...splats, uniforms: {...splats.uniforms, ...uniforms}, targets, clear, textures: {...splats.textures, picked}});
    let range = Math.max(this.#take.manifest.count, 1), picked = null;
    for (let level = 0; level < SEARCHES; level++) {
      const size = Math.ceil(range / BINS), uniforms = {sizes: [range, size, 0, 0]}, target = this.#texture(`picked${level % 2}`, width, height, "rgba32float");
      run(picked ? p.fineBins : p.bins, bins, [1, 1, 1, 1], uniforms, picked);
      gpu.draw(picked ? p.finePick : p.pick, {targets: [target], uniforms, textures: {passing, picked}});
      [range, picked] = [size, target];
    }
    const out = this.#texture(name, width, height, gpu.blendFormat);
    run(p.median, [out], [0, 0, 0, 0], {sizes: [range, 0, 0, 0]}, picked);
    return out;
  }

  /** Channels that the take has. */
  get channels() {
    return CHANNELS.filter((name) => name !== "radiance" || (this.#take && "radiance_0" in this.#take.raw));
  }

  /** Return captured colours towards a camera. */
  #captured(view) {
    const {place, textures} = this.#evaluated, bands = Object.keys(RADIANCE).filter((name) => name in this.#take.raw).length;
    const {heads, terms} = this.#sums(place, RADIANCE, 75), {positions} = this.#textures, target = this.#texture("captured", ROW, this.rows, "rgba32float");
    this.#programs.captured ??= this.gpu.program(passes.captured);
    this.gpu.draw(this.#programs.captured, {targets: [target], textures: {...textures, positions}, uniforms: {heads, terms, eye: [...view.position, bands]}});
    return target;
  }

  /** Draw the maps of a kind into layers of a texture, unless they are there; true if they were drawn. */
  #drawMaps(kind, name, size) {
    const maps = this.#maps[kind], views = maps.views.flat();
    if (maps.drawn || !views.length) return false;
    const shadows = this.#texture(name, size, size, "rgba32float", views.length);
    views.forEach((view, k) => {
      const sums = this.#texture("shadowSums", size, size, this.gpu.blendFormat);
      this.gpu.draw(this.#programs.depths, {...this.#splats(view, maps.orders[k], SHADOW_FILTERS), targets: [sums], clear: [0, 0, 0, 0]});
      const medians = this.#median(view, maps.orders[k], SHADOW_FILTERS, "shadowMedians");
      const meshes = (kind === "lamps" && this.meshDepth?.(view, k)) || this.#textures.nothing;
      this.gpu.draw(this.#programs.texels, {targets: [[shadows, k]], textures: {sums, medians, behindOf: meshes}, uniforms: {meshes: [meshes.width, 0, 0, 0]}});
    });
    return maps.drawn = true;
  }

  /** Find what arrives of the environment at each Gaussian, if shadows of its regions are known: the texture, or null. */
  #arriving() {
    const {views, environment, moments} = this.#maps.regions, t = this.#textures;
    if (!this.environmentShadows || this.channel !== "relit" || environment !== this.#environment) return null;
    this.#regionPrograms();
    const target = this.#texture("arriving", ROW, this.rows, "rgba32float");
    if (this.#drawMaps("regions", "regionShadows", REGION_SIDE)) {
      this.gpu.draw(this.#programs.arrive, {targets: [target], uniforms: {turn: this.#turn, counts: [views.length, 0, 0, 0], levels: this.levels,
        regions: moments, maps: views.flat().flatMap((each) => mapNumbers(each, this.#thickness))},
      textures: {positions: t.positions, colors: t.colors, normals: t.normals, environment: t.environment, albedo: t.albedo, shadows: t.regionShadows}});
    }
    return target;
  }

  /** How thick a layer of Gaussians is for shadows [m]. */
  get #thickness() {
    return this.#casters ? Math.min(this.thickness, THICKEST * this.#casters.radius) : 0;
  }

  /** The environment's angle about z as shaders take it, and its gain. */
  get #turn() {
    const angle = this.rotation * Math.PI / 180;
    return [Math.cos(angle), Math.sin(angle), this.environmentGain, 0];
  }

  /** Cameras of the lamps' shadow maps, as they were drawn last; `meshDepth(view, k)` may return depths of meshes for them. */
  get shadowViews() {
    return this.#maps.lamps.views.flat();
  }

  /** Draw shadow maps again: meshes have moved. */
  redrawShadows() {
    if (this.#maps.lamps.views.length) this.#maps.lamps.drawn = false;
  }

  /** Return a texture by its name, to be read by others who draw with the same GPU: "lit", "sums2", "positions" …. */
  texture(name) {
    return this.#textures[name];
  }

  /** Draw what is at hand now, lit, into textures: true if there is anything. */
  shade(camera) {
    if (this.#isLost || this.#isDisposed || !this.#take) return false;
    const regions = this.environmentShadows;
    require(Number.isInteger(regions) && regions >= 0 && regions <= passes.REGIONS, `environmentShadows must be an integer in [0, ${passes.REGIONS}]`, regions);
    const view = viewOf(camera), name = camera.name ?? "main", {width, height} = view;
    this.#advance();
    if (!this.#views.has(name)) this.#views.set(name, {});
    Object.assign(this.#views.get(name), {camera: view});
    this.#sort(name, false);
    const {order} = this.#views.get(name);
    if (!order || !this.#evaluated) return false;
    const t = this.#textures, format = this.gpu.blendFormat, {raster_low_pass: low, raster_antialiased: thin} = this.#take.manifest.metadata ?? {};
    const filters = [Number(low) > 0 ? Number(low) : 0.3, 0.01, thin === "true" ? 1 : 0, 0];
    const arriving = this.#arriving(), sums = Array.from({length: arriving ? 4 : 3}, (_, k) => this.#texture(`sums${k}`, width, height, format));
    const splats = this.#splats(view, order, filters);
    if (this.channel === "radiance") splats.textures.colors = this.#captured(view);
    splats.textures.arriving = arriving;
    this.gpu.draw(arriving ? this.#programs.gbufferArriving : this.#programs.gbuffer, {...splats, targets: sums, clear: [0, 0, 0, 0]});
    const maps = this.#maps.lamps, lights = this.#lights.length ? maps.lights ?? [] : [], hasLamps = lights.length > 0; // those that maps are of
    if (hasLamps) {
      this.#lampPrograms();
      this.#drawMaps("lamps", "shadows", this.shadowMapSize);
    }
    const medians = hasLamps ? this.#median(view, order, filters, "medians") : t.nothing;
    let first = 0;
    const lamps = lights.flatMap((light, k) => {
      const count = maps.views[k].length;
      first += count;
      return lampNumbers(light, first - count, count);
    });
    const lit = this.#texture("lit", width, height, "rgba32float");
    this.gpu.draw(this.#programs.deferred, {targets: [lit], textures: {sums0: sums[0], sums1: sums[1], sums2: sums[2], sums3: sums[3] ?? t.nothing, medians,
      environment: t.environment, albedo: t.albedo, shadows: this.#textures.shadows ?? t.noMap},
    uniforms: {...cameraNumbers(view, 0), turn: this.#turn, levels: this.levels, lamps,
      counts: [lights.length, this.background === "environment" && this.channel === "relit" ? 1 : 0, arriving ? 1 : 0, 0],
      maps: hasLamps ? maps.views.flat().flatMap((each) => mapNumbers(each, this.#thickness)) : []}});
    return true;
  }

  /** Draw what is at hand now on the canvas. After `sorted`, draw again: the order of depth has been found. */
  draw(camera) {
    const {width, height} = camera, channel = CHANNELS.indexOf(this.channel), transform = TRANSFORMS.indexOf(this.viewTransform);
    require(!this.#take || this.channels.includes(this.channel), `channel must be one of ${this.channels.join(", ")}`, this.channel);
    require(transform >= 0, `viewTransform must be one of ${TRANSFORMS.join(", ")}`, this.viewTransform);
    require(Number.isFinite(this.exposure) && Math.abs(this.exposure) <= 64, "exposure must be in [-64, 64] stops", this.exposure);
    if (!this.shade(camera)) return false;
    const {canvas} = this, t = this.#textures, target = camera.target;
    if (canvas && !target && (canvas.width !== width || canvas.height !== height)) Object.assign(canvas, {width, height});
    const targets = canvas || target ? [] : [this.#texture("picture", width, height, "rgba8unorm")];
    const behind = Array.isArray(this.background) ? [...this.background, 1] : [0, 0, 0, 0];
    this.gpu.draw(this.#programs.display, {textures: {lit: t.lit, sums0: t.sums0, sums1: t.sums1, sums2: t.sums2}, target, targets,
      uniforms: {image: [width, height, target?.x ?? 0, target?.y ?? 0], tone: [2 ** this.exposure, transform, channel, this.#take.manifest.radianceColorSpace === "srgb_rec709_display" ? 1 : 0],
        background: behind, range: this.depthRange ?? this.#depthRange(viewOf(camera))}});
    return true;
  }

  #depthRange(view) {
    const {center, radius} = this.#casters ?? {center: [0, 0, 0], radius: 1};
    const middle = center.reduce((sum, value, k) => sum + (value - view.position[k]) * view.forward[k], 0);
    return [Math.max(middle - radius, 0.01), middle + radius];
  }

  /** Resolves when the moment's segment is here, or cannot be read, and all that was drawn last is in order. */
  async ready() {
    require(this.#take, "a take must be open", null);
    for (const segments = this.#segments; segments && segments === this.#segments && !this.#isLost && !this.#isDisposed;) {
      const {number} = this.#place();
      segments.want(number);
      if (segments.has(number) || segments.hasFailed(number)) break;
      await segments.load(number);
    }
    if (this.#isLost || this.#isDisposed || !this.#segments) return;
    this.#advance();
    for (const name of this.#views.keys()) await this.#sort(name, true);
  }

  /** Draw a moment as it is: its segment is fetched, and everything is in order of depth. True if it was drawn. */
  async render(camera) {
    this.shade(camera);
    await this.ready();
    return this.draw(camera);
  }

  /**
   * Return what was drawn last, RGBA a pixel, top row first: "lit", floats (radiance times alpha, and alpha); "picture",
   * bytes for a display, of a renderer without a canvas; "sums0" … "sums2" and "medians", the G-buffer.
   */
  async read(name = "lit") {
    require(this.#textures[name], "what is read must have been drawn", name);
    return this.gpu.read(this.#textures[name]);
  }
}

const texels = (texture) => texture ? texture.width * texture.height * texture.layers : 0;
const mapped = (object, change) => Object.fromEntries(Object.entries(object).map(([k, v]) => [k, change(v)]));

/** Return the median over Gaussians of the middle one of three standard deviations [m]. */
function middleScale(scales, count) {
  if (!count) return 0;
  const middles = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    const a = scales[i], b = scales[count + i], c = scales[2 * count + i];
    middles[i] = Math.max(Math.min(a, b), Math.min(Math.max(a, b), c));
  }
  middles.sort();
  return 0.5 * (middles[(count - 1) >> 1] + middles[count >> 1]);
}
