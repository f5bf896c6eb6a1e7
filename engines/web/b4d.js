/**
 * Reader of the delivery container b4d in plain JavaScript: typed arrays, fetch and crypto.subtle.
 * docs/delivery.md specifies the container. Arrays are planar: all x, then all y, then all z.
 *
 *     const take = await Take.open("person.b4d");
 *     const frame = await take.frame(12);  // {positions: Float32Array(3 N), orientations: Float32Array(4 N), ...}
 */

import {inflating} from "./inflate.js";

const HEAD_BYTES = 2 ** 16, MAX_MANIFEST_BYTES = 2 ** 26, FREE_BYTES = 2 ** 24, MAX_RATIO = 64, FREE_COUNT = 2 ** 18, MAX_FRAMES = 30;
const COMPONENTS = {positions: 3, orientations: 3, turns: 3, scales: 3, opacities: 1, base_color: 3, roughness: 1, ambient_occlusion: 1, normals: 3};
for (let k = 0; k < 25; k++) COMPONENTS[`radiance_${k}`] = 3;

/** A container breaks its format; the message names the file in it. */
export class DeliveryError extends Error {}

const require = (condition, contract, got) => { if (!condition) throw new DeliveryError(`${contract}, got ${String(JSON.stringify(got)).slice(0, 80)}.`); };

const whole = (value, name, least, most) =>
  (require(Number.isSafeInteger(value) && value >= least && value <= most, `${name} must be in [${least}, ${most}]`, value), value);

/** Reads ranges of a file at a URL; a server without ranges sends the whole file, of which the range is taken. */
const rangesOf = (url) => async (name, start, size, signal) => {
  const place = name === null ? url : new URL(name, new URL(url, globalThis.location?.href));
  const answer = await fetch(place, {signal, headers: {Range: `bytes=${start}-${start + size - 1}`}});
  require(answer.ok, `${name ?? url} must be within reach`, answer.status);
  const content = new Uint8Array(await answer.arrayBuffer());
  return answer.status === 206 ? content : content.subarray(start, start + size);
};

/** A take that is open for playing. */
export class Take {
  /**
   * Open a `.b4d` file or a `manifest.json`.
   * @param {string} url
   * @param {(name: string|null, start: number, size: number, signal?: AbortSignal) => Promise<Uint8Array>} [read] Reads a
   *     range of the file (name null) or of a file beside the manifest; by default with fetch.
   */
  static async open(url, read = rangesOf(url)) {
    const take = Object.assign(new Take(), {read, isArchive: !url.endsWith(".json"), start: 0, unpack: unpacking()});
    let content = await read(null, 0, HEAD_BYTES);
    if (take.isArchive) {
      const head = new DataView(content.buffer, content.byteOffset, content.byteLength);
      require(content.length >= 30 && head.getUint32(0, true) === 0x04034b50 && head.getUint16(8, true) === 0, "a b4d file must be a zip archive, stored", [...content.slice(0, 4)]);
      const size = head.getUint32(18, true), at = 30 + head.getUint16(26, true) + head.getUint16(28, true);
      take.start = at + size;
      if (take.start > content.length) content = await read(null, 0, take.start);
      content = content.subarray(at, take.start);
    } else if (content.length === HEAD_BYTES) content = await read(null, 0, MAX_MANIFEST_BYTES);
    // Not by a Response: in Node.js it detaches a buffer, and from then on V8 checks every access to every typed array.
    try { take.manifest = JSON.parse(new TextDecoder().decode(content)); } catch (error) { throw new DeliveryError(`manifest.json must be JSON, got ${error.message}.`); }
    check(take.manifest);
    const tracks = await take.tracks(take.manifest.static, 1);
    for (const name of ["positions", "orientations", "scales", "opacities"]) require(name in tracks, `the static block must hold ${name}`, Object.keys(tracks));
    take.none = new Float32Array(take.manifest.count);
    take.raw = mapped(tracks, (track) => valuesAt(track, 0, take.none, null, new Float32Array(track.length * take.none.length)));
    take.still = mapped(take.raw, (values, name) => activated(name, values.slice()));
    return take;
  }

  /** Open a `.b4d` file that is at hand: its bytes, or a Blob; a page needs no server for it. */
  static from(content, file = new Blob([content])) {
    return Take.open("bytes.b4d", async (_, start, size) => new Uint8Array(await file.slice(start, start + size).arrayBuffer()));
  }

  /**
   * Return the arrays of a block, after one request.
   * @param {object} entry `manifest.static`, or one of `manifest.segments`.
   * @param {number} frames
   * @param {(block: object) => Promise<object>} [unpack] What `unpacking` returns, perhaps in a worker.
   * @param {AbortSignal} [signal] Ends the request early.
   * @param {{packed: Uint8Array}} [held] Keeps the bytes; no request is made for those that it has.
   */
  async tracks(entry, frames, unpack = this.unpack, signal = undefined, held = {}) {
    const [name, start] = this.isArchive ? [null, this.start + entry.offset] : [entry.file, 0];
    held.packed ??= await this.read(name, start, entry.bytes, signal);
    const {tracks} = await unpack({packed: held.packed, entry, frames, count: this.manifest.count}).catch((error) => { throw new DeliveryError(error.message); });
    for (const [array, {length}] of Object.entries(tracks)) require(length === COMPONENTS[array], `${entry.file} must hold arrays that are known`, array);
    return tracks;
  }

  /**
   * Return a frame; its segment is fetched if it is not the one of the last call, and of its planes those are unpacked that
   * the frame needs. Summed planes are kept for the next frame.
   * @param {number} number
   * @param {object} [into] As for `frameOf`.
   */
  async frame(number, into = {}) {
    whole(number, "frame", 0, this.manifest.frames - 1);
    const entry = this.manifest.segments.find(({first, frames}) => number < first + frames), frame = number - entry.first;
    const held = this.held?.entry === entry ? this.held : {entry};
    // Summed planes of the segment before give their memory. Calls that overlap do not meet: nothing else runs from the first `row` to `use`.
    const row = () => this.held !== held && this.held?.entry.parts && Object.values(this.held.tracks).flat().find(({planes, first}) => planes.splice(first) && planes.length)?.planes.pop();
    const use = (tracks) => { found = this.frameOf(tracks, frame, into), this.held = Object.assign(held, {tracks}); };
    let found;
    await this.tracks(entry, entry.frames, (block) => this.unpack({...block, frame, tracks: held.tracks, row, use}), undefined, held);
    return found;
  }

  /**
   * Return a frame of a segment whose tracks are at hand; arrays that do not change are shared between frames.
   * @param {object} tracks
   * @param {number} frame Counted from the first one of the segment.
   * @param {object} [into] A frame that is not needed any more: its arrays are written over, which takes less time than new ones.
   */
  frameOf(tracks, frame, into = {}) {
    const {turns, ...others} = tracks, {count} = this.manifest, found = {...this.still};
    const room = (name, rows) => (into[name]?.length === rows * count && into[name] !== this.still[name] ? into[name] : new Float32Array(rows * count));
    const sums = (name, values) => valuesAt(tracks[name], frame, this.none, this.raw[name], values ?? room(name, tracks[name].length));
    for (const name of Object.keys(others)) found[name] = turns && name === "normals" ? sums(name) : activated(name, sums(name));
    if (!turns) return found;
    this.turns = sums("turns", this.turns ?? new Float32Array(3 * count));
    const {orientations, normals} = found, turned = others.normals ? normals : normals && room("normals", 3);
    return Object.assign(found, {orientations: turn(this.turns, count, orientations, room("orientations", 4), normals, turned)}, normals && {normals: turned});
  }
}

const mapped = (object, change) => Object.fromEntries(Object.entries(object).map(([k, v]) => [k, change(v, k)]));

function check(said) {
  require(said?.format === "b4d" && said.version === 1, "version must be 1 of b4d", said?.version);
  require(said.static && Array.isArray(said.segments), "static and segments must be there", said.segments);
  for (const entry of [said.static, ...said.segments]) {
    require(/^[\w-][\w.-]{0,200}$/.test(entry?.file), "blocks must say their file, a name beside the manifest", entry?.file);
    whole(entry.offset, "offset", 0, 2 ** 53 - 1);
    whole(entry.unpacked, "unpacked", 4, Math.min(FREE_BYTES + MAX_RATIO * whole(entry.bytes, "bytes", 1, 2 ** 40), 2 ** 31));
  }
  whole(said.count, "count", 0, FREE_COUNT + said.static.bytes);
  const following = said.segments.reduce((at, {first, frames}) => whole(first, "first", at, at) + whole(frames, "frames", 1, MAX_FRAMES), 0);
  whole(said.frames, "frames", Math.max(following, 1), following);
}

/**
 * Return the function that unpacks a block, given its bytes, its entry in the manifest, its number of frames, and of
 * Gaussians. With a `frame`, only the planes that it needs, where the block has parts, beside those in `tracks`, which an
 * earlier call gave. Then `use` is called with the tracks before the next call writes over their octets, and `row` may give memory.
 * A worker can run this one: it uses nothing outside of itself and of `inflating`. `transfer` lists the memory of the answer.
 */
export function unpacking({inflate, inflated, SPARE} = inflating()) {
  const must = (condition, contract, got) => { if (!condition) throw new Error(`${contract}, got ${String(JSON.stringify(got)).slice(0, 80)}.`); };

  /** Return the whole numbers of a plane. */
  function plane(octets, count, size, isSummed, row) {
    const numbers = row?.() || new Float32Array(count), kept = isSummed ? -1 : 0; // all bits, or none
    for (let i = 0, sum = 0; i < count; i = i + 1 | 0) {
      const code = octets[i] | (size > 1 ? octets[count + i | 0] << 8 : 0) | (size > 2 ? octets[2 * count + i | 0] << 16 : 0) | (size > 3 ? octets[3 * count + i | 0] << 24 : 0);
      numbers[i] = sum = (sum & kept) + (code >>> 1 ^ -(code & 1)) | 0;
    }
    return numbers;
  }

  /** Return the tracks that a block describes, without planes, and where those begin. */
  function described(content, frames, count, unpacked) {
    let tracks = {}, at = 4 + new DataView(content.buffer, content.byteOffset).getUint32(0, true), end = 0;
    for (const {name, planes} of JSON.parse(new TextDecoder().decode(content.subarray(4, at))).arrays) tracks[name] = planes.map(([summed, plain]) => {
      const sizes = [...summed, ...plain], columns = 1 + sizes.length, weights = new Float32Array(content.slice(at, at += 4 * frames * columns).buffer);
      must(sizes.every((size) => [1, 2, 3, 4].includes(size)) && weights.every((w) => Math.abs(w) <= 1e6), "planes must have 1 to 4 bytes, and weights at most 1e6", name);
      end += sizes.reduce((sum, size) => sum + size * count, 0);
      return {sizes, first: summed.length, columns, weights, planes: []};
    });
    must(at <= content.length && at + end === unpacked, `planes must fill ${unpacked} bytes`, at + end);
    return {tracks, at};
  }

  let octets = new Uint8Array(0); // those that one frame needs
  return async ({packed, entry: {file, bytes, unpacked, sha256, parts}, frames, count, frame, tracks, row, use}) => {
    must(packed.length === bytes, `${file} must have ${bytes} bytes`, packed.length);
    const digest = !tracks && await globalThis.crypto?.subtle?.digest("SHA-256", packed); // pages from http have none
    const digits = digest ? Array.from(new Uint8Array(digest), (byte) => byte.toString(16).padStart(2, "0")).join("") : sha256;
    must(digits === sha256, `${file} must have the digest that the manifest says`, digits);
    try {
      const wanted = [], isAll = !parts || frame === undefined;
      let content, at = 0, start = parts ? parts[0] : bytes, part = 0;
      if (!tracks) {
        content = inflated(packed, 2, start, unpacked);
        ({tracks, at} = described(content, frames, count, unpacked));
      }
      const components = Object.values(tracks).flat();
      for (const {sizes, first, columns, weights, planes} of components) sizes.forEach((size, k) => {
        must(!parts || parts[++part] > 0, "parts must be as many as planes", parts?.[part]);
        const from = start, to = start += parts?.[part] ?? 0, isSummed = k < first, isPlain = size === 1 && !isSummed, isNeeded = isAll || isSummed || weights[frame * columns + 1 + k];
        if (isNeeded && (!planes[k] || isPlain && !isAll)) wanted.push({planes, k, size, isSummed, isPlain, from, to});
      });
      const room = count * (4 + wanted.filter(({isPlain}) => isPlain).length) + SPARE; // plain octets stay; other planes only pass through
      if (parts) content = isAll ? new Uint8Array(room) : octets.length < room ? octets = new Uint8Array(room) : octets, at = 0;
      for (const {planes, k, size, isSummed, isPlain, from, to} of wanted) {
        const most = size * count, codes = content.subarray(at, at + most);
        const length = parts ? inflate(packed, from, to, content.subarray(at, at + most + SPARE), isPlain) : codes.length;
        must(length === most, "planes must be as long as they say", length);
        planes[k] = isPlain ? new Int8Array(content.buffer, at, count) : plane(codes, count, size, isSummed, row);
        if (isPlain && !parts) for (let i = 0; i < count; i++) codes[i] = codes[i] >> 1 ^ -(codes[i] & 1);
        if (isPlain || !parts) at += most;
      }
      use?.(tracks);
      return {tracks, transfer: [...new Set(components.flatMap(({planes}) => planes.map(({buffer}) => buffer)))]};
    } catch (error) {
      throw new Error(`${file} must be a sound block, got: ${error.message}`);
    }
  };
}

/** Return offset plus weights times planes for each component, plus what the static block says; `none` is a row of zeros. */
function valuesAt(track, frame, none, start, values) {
  const count = none.length;
  track.forEach(({columns, weights, planes}, c) => {
    const part = (all) => all.subarray(c * count, (c + 1) * count), out = part(values), at = frame * columns;
    const [wide, octets] = [Float32Array, Int8Array].map((kind) => planes.flatMap((row, k) => (row instanceof kind && weights[at + 1 + k] ? [[row, weights[at + 1 + k]]] : [])));
    if (start) wide.unshift([part(start), 1]);
    const next = () => wide.shift() ?? [none, 0], isOdd = wide.length > 2 && wide.length & 1; // a row and its weight
    (isOdd ? putThree : putTwo)(out, weights[at], ...(octets.shift() ?? [new Int8Array(none.buffer), 0]), ...next(), ...next(), ...(isOdd ? next() : []));
    for (const octet of octets) putTwo(out, 0, ...octet, out, 1, ...next());
    while (wide.length) addTwo(out, ...next(), ...next());
  });
  return values;
}

/** Put an offset, weighted octets and two weighted rows; eight numbers at a time, because the loop itself costs much of such a sum. */
function putTwo(out, offset, o, w, a, p, b, q) {
  let i = 0, count = out.length;
  for (; i < (count & 7); i++) out[i] = offset + w * o[i] + p * a[i] + q * b[i];
  for (; i < count; i = i + 8 | 0) {
    const j = i + 1 | 0, k = i + 2 | 0, l = i + 3 | 0, m = i + 4 | 0, n = i + 5 | 0, r = i + 6 | 0, s = i + 7 | 0;
    out[i] = offset + w * o[i] + p * a[i] + q * b[i], out[j] = offset + w * o[j] + p * a[j] + q * b[j], out[k] = offset + w * o[k] + p * a[k] + q * b[k];
    out[l] = offset + w * o[l] + p * a[l] + q * b[l], out[m] = offset + w * o[m] + p * a[m] + q * b[m], out[n] = offset + w * o[n] + p * a[n] + q * b[n];
    out[r] = offset + w * o[r] + p * a[r] + q * b[r], out[s] = offset + w * o[s] + p * a[s] + q * b[s];
  }
}

/** The same with three weighted rows. */
function putThree(out, offset, o, w, a, p, b, q, c, z) {
  let i = 0, count = out.length;
  for (; i < (count & 7); i++) out[i] = offset + w * o[i] + p * a[i] + q * b[i] + z * c[i];
  for (; i < count; i = i + 8 | 0) {
    const j = i + 1 | 0, k = i + 2 | 0, l = i + 3 | 0, m = i + 4 | 0, n = i + 5 | 0, r = i + 6 | 0, s = i + 7 | 0;
    out[i] = offset + w * o[i] + p * a[i] + q * b[i] + z * c[i], out[j] = offset + w * o[j] + p * a[j] + q * b[j] + z * c[j];
    out[k] = offset + w * o[k] + p * a[k] + q * b[k] + z * c[k], out[l] = offset + w * o[l] + p * a[l] + q * b[l] + z * c[l];
    out[m] = offset + w * o[m] + p * a[m] + q * b[m] + z * c[m], out[n] = offset + w * o[n] + p * a[n] + q * b[n] + z * c[n];
    out[r] = offset + w * o[r] + p * a[r] + q * b[r] + z * c[r], out[s] = offset + w * o[s] + p * a[s] + q * b[s] + z * c[s];
  }
}

/** Add two weighted rows, in the same way. */
function addTwo(out, a, p, b, q) {
  let i = 0, count = out.length;
  for (; i < (count & 7); i++) out[i] += p * a[i] + q * b[i];
  for (; i < count; i = i + 8 | 0) {
    const j = i + 1 | 0, k = i + 2 | 0, l = i + 3 | 0, m = i + 4 | 0, n = i + 5 | 0, r = i + 6 | 0, s = i + 7 | 0;
    out[i] += p * a[i] + q * b[i], out[j] += p * a[j] + q * b[j], out[k] += p * a[k] + q * b[k], out[l] += p * a[l] + q * b[l];
    out[m] += p * a[m] + q * b[m], out[n] += p * a[n] + q * b[n], out[r] += p * a[r] + q * b[r], out[s] += p * a[s] + q * b[s];
  }
}

/** Turn numbers of an array into what they stand for, in place where that is possible. */
function activated(name, values) {
  const count = values.length / COMPONENTS[name], none = () => new Float32Array(4 * count), isColor = name !== "positions" && !name.startsWith("radiance");
  if (name === "orientations") return turn(values, count, none().fill(1, 3 * count), none());
  if (name === "normals") turn(none(), count, none(), none(), values, values);
  else if (name === "scales") for (let i = 0; i < values.length; i++) values[i] = values[i] < -29 ? 0 : Math.exp(Math.min(values[i], 20));
  else if (isColor) for (let i = 0; i < values.length; i = i + 1 | 0) if (values[i] < 0) values[i] = 0; else if (values[i] > 1) values[i] = 1;
  return values;
}

/**
 * Put quaternions xyzw turned by modified Rodrigues parameters, axis times tan(angle / 4), and unit normals turned by them;
 * normals may have any length, and may be turned in place. All is read before anything is written, which takes less time.
 */
function turn(turns, count, from, to, normals = turns, turned = new Float32Array(3 * count)) {
  for (let i = 0; i < count; i = i + 1 | 0) {
    const j = i + count | 0, k = j + count | 0, l = k + count | 0, e = turns[i], f = turns[j], g = turns[k], share = 2 / (1 + e * e + f * f + g * g);
    const a = e * share, b = f * share, c = g * share, d = share - 1, x = from[i], y = from[j], z = from[k], w = from[l];
    const u = normals[i], v = normals[j], n = normals[k], unit = 1 / Math.sqrt(u * u + v * v + n * n + 1e-24);
    const p = 2 * (b * n - c * v), q = 2 * (c * u - a * n), r = 2 * (a * v - b * u);
    to[i] = d * x + a * w + b * z - c * y, to[j] = d * y + b * w + c * x - a * z, to[k] = d * z + c * w + a * y - b * x, to[l] = d * w - a * x - b * y - c * z;
    turned[i] = unit * (u + d * p + b * r - c * q), turned[j] = unit * (v + d * q + c * p - a * r), turned[k] = unit * (n + d * r + a * q - b * p);
  }
  return to;
}
