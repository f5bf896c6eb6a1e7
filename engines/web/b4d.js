/**
 * Reader of the delivery container b4d in plain JavaScript: typed arrays, fetch, DecompressionStream and crypto.subtle.
 * docs/delivery.md specifies the container. Arrays are planar: all x, then all y, then all z.
 *
 *     const take = await Take.open("person.b4d");
 *     const frame = await take.frame(12);  // {positions: Float32Array(3 N), orientations: Float32Array(4 N), ...}
 */

const MANIFEST = "manifest.json", HEAD_BYTES = 2 ** 16, MAX_MANIFEST_BYTES = 2 ** 26;
const FREE_BYTES = 2 ** 24, MAX_RATIO = 64, FREE_COUNT = 2 ** 18, MAX_FRAMES = 30;
const COMPONENTS = {positions: 3, orientations: 3, turns: 3, scales: 3, opacities: 1, base_color: 3, roughness: 1, ambient_occlusion: 1, normals: 3};
for (let k = 0; k < 25; k++) COMPONENTS[`radiance_${k}`] = 3;

/** A container breaks its format; the message names the file in it. */
export class DeliveryError extends Error {}

function require(condition, contract, got) {
  if (!condition) throw new DeliveryError(`${contract}, got ${String(JSON.stringify(got)).slice(0, 80)}.`);
}

function whole(value, name, least, most) {
  require(Number.isSafeInteger(value) && value >= least && value <= most, `${name} must be in [${least}, ${most}]`, value);
  return value;
}

/** Reads ranges of a file at a URL; a server without ranges sends the whole file, of which the range is taken. */
function rangesOf(url) {
  return async (name, start, size, signal) => {
    const place = name === null ? url : new URL(name, new URL(url, globalThis.location?.href));
    const answer = await fetch(place, {signal, headers: {Range: `bytes=${start}-${start + size - 1}`}});
    require(answer.ok, `${name ?? url} must be within reach`, answer.status);
    const content = new Uint8Array(await answer.arrayBuffer());
    return answer.status === 206 ? content : content.subarray(start, start + size);
  };
}

/** A take that is open for playing. */
export class Take {
  /**
   * Open a `.b4d` file or a `manifest.json`.
   * @param {string} url
   * @param {(name: string|null, start: number, size: number, signal?: AbortSignal) => Promise<Uint8Array>} [read] Reads a
   *     range of the file (name null) or of a file beside the manifest; by default with fetch.
   */
  static async open(url, read = rangesOf(url)) {
    const take = Object.assign(new Take(), {read, isArchive: !url.endsWith(".json"), start: 0});
    let content = await read(null, 0, HEAD_BYTES);
    if (take.isArchive) {
      const head = new DataView(content.buffer, content.byteOffset, content.byteLength);
      const isZip = content.length >= 30 && head.getUint32(0, true) === 0x04034b50;
      require(isZip && head.getUint16(8, true) === 0, "a b4d file must be a zip archive, stored", [...content.slice(0, 4)]);
      const size = head.getUint32(18, true), at = 30 + head.getUint16(26, true) + head.getUint16(28, true);
      take.start = at + size;
      if (take.start > content.length) content = await read(null, 0, take.start);
      content = content.subarray(at, take.start);
    } else if (content.length === HEAD_BYTES) content = await read(null, 0, MAX_MANIFEST_BYTES);
    try {
      take.manifest = JSON.parse(new TextDecoder().decode(content));
    } catch (error) {
      throw new DeliveryError(`${MANIFEST} must be JSON, got ${error.message}.`);
    }
    check(take.manifest);
    const tracks = await take.tracks(take.manifest.static, 1);
    const missing = ["positions", "orientations", "scales", "opacities"].filter((name) => !(name in tracks));
    require(!missing.length, "the static block must hold positions, orientations, scales and opacities", missing);
    take.raw = mapped(tracks, (track) => valuesAt(track, 0, take.manifest.count, null));
    take.still = mapped(take.raw, (values, name) => activated(name, values.slice()));
    return take;
  }

  /** Open a `.b4d` file that is at hand: its bytes, or a Blob; a page needs no server for it. */
  static from(content) {
    const part = (start, size) => new Blob([content]).slice(start, start + size).arrayBuffer();
    return Take.open("bytes.b4d", async (_, start, size) => new Uint8Array(await part(start, size)));
  }

  /**
   * Return the arrays of a block, after one request.
   * @param {object} entry `manifest.static`, or one of `manifest.segments`.
   * @param {number} frames
   * @param {(block: object) => Promise<object>} [unpack] What `unpacking` returns, perhaps in a worker.
   * @param {AbortSignal} [signal] Ends the request early.
   */
  async tracks(entry, frames, unpack = unpacking(), signal = undefined) {
    const [name, start] = this.isArchive ? [null, this.start + entry.offset] : [entry.file, 0];
    const packed = await this.read(name, start, entry.bytes, signal);
    const {tracks} = await unpack({packed, entry, frames, count: this.manifest.count}).catch((error) => { throw new DeliveryError(error.message); });
    for (const [array, {length}] of Object.entries(tracks)) require(length === COMPONENTS[array], `${entry.file} must hold arrays that are known`, array);
    return tracks;
  }

  /** Return a frame; its segment is fetched and unpacked if it is not the one of the last call. */
  async frame(number) {
    whole(number, "frame", 0, this.manifest.frames - 1);
    const entry = this.manifest.segments.find(({first, frames}) => number < first + frames);
    if (this.unpacked?.entry !== entry) this.unpacked = {entry, tracks: await this.tracks(entry, entry.frames)};
    return this.frameOf(this.unpacked.tracks, number - entry.first);
  }

  /** Return a frame of a segment whose tracks are at hand; arrays that do not change are shared between frames. */
  frameOf(tracks, frame) {
    const count = this.manifest.count, found = {...this.still};
    const {turns, ...values} = mapped(tracks, (track, name) => valuesAt(track, frame, count, this.raw[name]));
    for (const name of Object.keys(values)) found[name] = turns && name === "normals" ? values[name] : activated(name, values[name]);
    return turns ? turn(found, turns, count, values.normals) : found;
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
  let following = 0;
  for (const {first, frames} of said.segments) following = whole(first, "first", following, following) + whole(frames, "frames", 1, MAX_FRAMES);
  whole(said.frames, "frames", Math.max(following, 1), following);
}

/**
 * Return the function that unpacks a block, given its bytes, its entry in the manifest, its number of frames, and of
 * Gaussians. A worker can run this one: it uses nothing outside of itself. `transfer` lists the memory of the answer.
 */
export function unpacking() {
  const must = (condition, contract, got) => { if (!condition) throw new Error(`${contract}, got ${String(JSON.stringify(got)).slice(0, 80)}.`); };

  /** Put 0, -1, 1, -2, 2 … where octets 0, 1, 2, 3, 4 … stand: four at a time, but for those before and after whole words. */
  function signed({buffer, byteOffset, length}) {
    const head = Math.min(-byteOffset & 3, length), tail = length - ((length - head) & 3), numbers = new Int8Array(buffer, byteOffset, length);
    const words = new Uint32Array(buffer, byteOffset + head, (tail - head) / 4);
    for (let k = 0; k < words.length; k++) words[k] = ((words[k] >>> 1) & 0x7f7f7f7f) ^ (255 * (words[k] & 0x01010101));
    for (let i = head ? 0 : tail; i < length; i = i + 1 === head ? tail : i + 1) numbers[i] = ((numbers[i] & 255) >>> 1) ^ -(numbers[i] & 1);
    return numbers;
  }

  /** Return the whole numbers of a plane, in its own place if they are octets. Loops that meet one kind of array are fast. */
  function plane(octets, count, size, isSummed) {
    if (size === 1 && !isSummed) return signed(octets);
    const [a, b, c, d] = [0, 1, 2, 3].map((k) => octets.subarray(k < size ? k * count : 0)), [m, n, o] = [2, 3, 4].map((k) => (k <= size ? -1 : 0));
    const numbers = new Float32Array(count), kept = isSummed ? -1 : 0; // all bits of the sum so far, or none
    if (size < 3) for (let i = 0, sum = 0; i < count; i++) {
      const code = a[i] | b[i] << 8 & m;
      numbers[i] = sum = ((sum & kept) + ((code >>> 1) ^ -(code & 1))) | 0;
    } else for (let i = 0, sum = 0; i < count; i++) {
      const code = a[i] | b[i] << 8 | c[i] << 16 & n | d[i] << 24 & o;
      numbers[i] = sum = ((sum & kept) + ((code >>> 1) ^ -(code & 1))) | 0;
    }
    return numbers;
  }

  function split(content, frames, count) {
    const tracks = {};
    let at = 4 + new DataView(content.buffer).getUint32(0, true);
    for (const {name, planes} of JSON.parse(new TextDecoder().decode(content.subarray(4, at))).arrays) {
      tracks[name] = planes.map(([summed, plain]) => {
        const columns = 1 + summed.length + plain.length, weights = new Float32Array(content.slice(at, at += 4 * frames * columns).buffer);
        must(weights.every((w) => Math.abs(w) <= 1e6), "weights must be at most 1e6", name);
        return {sizes: [...summed, ...plain], first: summed.length, columns, weights};
      });
    }
    const components = Object.values(tracks).flat();
    for (const component of components) component.planes = component.sizes.map((size, k) => {
      must(size >= 1 && size <= 4 && at + size * count <= content.length, "it must hold all planes, of 1 to 4 bytes a number", size);
      return plane(content.subarray(at, at += size * count), count, size, k < component.first);
    });
    must(at === content.length, "it must be filled by its planes", at);
    return {tracks, transfer: [...new Set(components.flatMap(({planes}) => planes.map(({buffer}) => buffer)))]};
  }

  /** Return what a stream unpacks to; an error if it is damaged, or not as long as it should be. */
  async function inflated(packed, size) {
    const stream = new DecompressionStream("deflate"), writer = stream.writable.getWriter(), reader = stream.readable.getReader(), content = new Uint8Array(size);
    Promise.all([writer.write(packed), writer.close()]).catch(() => {}); // the reader meets it too
    let end = 0;
    for (let part; !(part = await reader.read()).done; end += part.value.length) content.set(part.value, end);
    return end === size ? content : new Error(`${end}`);
  }

  return async ({packed, entry: {file, bytes, unpacked, sha256}, frames, count}) => {
    must(packed.length === bytes, `${file} must have ${bytes} bytes`, packed.length);
    const digest = globalThis.crypto?.subtle?.digest("SHA-256", packed); // pages from http have none
    const content = await inflated(packed, unpacked).catch((error) => error);
    const digits = digest && Array.from(new Uint8Array(await digest), (byte) => byte.toString(16).padStart(2, "0")).join("");
    must(!digest || digits === sha256, `${file} must have the digest that the manifest says`, digits);
    must(content instanceof Uint8Array, `${file} must unpack to ${unpacked} bytes`, content.message);
    try {
      return split(content, frames, count);
    } catch (error) {
      throw new Error(`${file} must be a sound block, got: ${error.message}`);
    }
  };
}

/** Return offset plus weights times planes for each component, plus what the static block says. */
function valuesAt(track, frame, count, start) {
  const values = new Float32Array(track.length * count), none = new Int8Array(count);
  track.forEach(({columns, weights, planes}, c) => {
    const part = (all) => all.subarray(c * count, (c + 1) * count), out = part(values), at = frame * columns;
    const used = planes.map((numbers, k) => [numbers, weights[at + 1 + k]]).filter(([, weight]) => weight);
    const [wide, octets] = [Float32Array, Int8Array].map((kind) => used.filter(([numbers]) => numbers instanceof kind));
    if (start) wide.unshift([part(start), 1]);
    for (let offset = weights[at], isFirst = true; isFirst || wide.length || octets.length; offset = 0, isFirst = false) {
      if (!isFirst) wide.unshift([out, 1]);
      const [add, most] = wide.length > 2 ? [addFour, 4] : [addTwo, 2];
      add(out, offset, ...(octets.shift() ?? [none, 0]), ...Array.from({length: most}, () => wide.shift() ?? [out, 0]).flat());
    }
  });
  return values;
}

const addTwo = (out, offset, o, w, a, p, b, q) => { for (let i = 0; i < out.length; i++) out[i] = offset + w * o[i] + p * a[i] + q * b[i]; };
const addFour = (out, offset, o, w, a, p, b, q, c, r, d, s) => { for (let i = 0; i < out.length; i++) out[i] = offset + w * o[i] + p * a[i] + q * b[i] + r * c[i] + s * d[i]; };

/** Turn numbers of an array into what they stand for, in place where that is possible. */
function activated(name, values) {
  const count = values.length / COMPONENTS[name], isColor = name !== "positions" && !name.startsWith("radiance");
  if (name === "orientations") return quaternions(values, count);
  if (name === "scales") {
    for (let i = 0; i < values.length; i++) values[i] = values[i] < -29 ? 0 : Math.exp(Math.min(values[i], 20));
  } else if (name === "normals") {
    for (let i = 0, j = count, k = 2 * count; i < count; i++, j++, k++) {
      const x = values[i], y = values[j], z = values[k], share = 1 / Math.max(Math.sqrt(x * x + y * y + z * z), 1e-12);
      values[i] = x * share, values[j] = y * share, values[k] = z * share;
    }
  } else if (isColor) {
    for (let i = 0; i < values.length; i++) values[i] = values[i] < 0 ? 0 : values[i] > 1 ? 1 : values[i];
  }
  return values;
}

/** Return the unit quaternions xyzw of modified Rodrigues parameters, axis times tan(angle / 4). */
function quaternions(values, count) {
  const found = new Float32Array(4 * count);
  for (let i = 0, j = count, k = 2 * count, l = 3 * count; i < count; i++, j++, k++, l++) {
    const x = values[i], y = values[j], z = values[k], square = x * x + y * y + z * z, share = 1 / (1 + square);
    found[i] = 2 * x * share, found[j] = 2 * y * share, found[k] = 2 * z * share, found[l] = (1 - square) * share;
  }
  return found;
}

/** Turn orientations, and normals where there are any, by modified Rodrigues parameters; normals may have any length (`own`: in place). */
function turn(arrays, turns, count, own) {
  const from = arrays.orientations, to = new Float32Array(4 * count), normals = arrays.normals, turned = own ?? (normals && new Float32Array(3 * count));
  for (let i = 0, j = count, k = 2 * count, l = 3 * count; i < count; i++, j++, k++, l++) {
    const e = turns[i], f = turns[j], g = turns[k], s = e * e + f * f + g * g, share = 1 / (1 + s), two = share + share;
    const a = e * two, b = f * two, c = g * two, d = (1 - s) * share, x = from[i], y = from[j], z = from[k], w = from[l];
    to[i] = d * x + a * w + b * z - c * y, to[j] = d * y + b * w + c * x - a * z;
    to[k] = d * z + c * w + a * y - b * x, to[l] = d * w - a * x - b * y - c * z;
    if (!normals) continue;
    const u = normals[i], v = normals[j], n = normals[k], unit = 1 / Math.max(Math.sqrt(u * u + v * v + n * n), 1e-12);
    const p = 2 * (b * n - c * v), q = 2 * (c * u - a * n), r = 2 * (a * v - b * u);
    turned[i] = unit * (u + d * p + b * r - c * q), turned[j] = unit * (v + d * q + c * p - a * r), turned[k] = unit * (n + d * r + a * q - b * p);
  }
  return Object.assign(arrays, {orientations: to}, normals && {normals: turned});
}
