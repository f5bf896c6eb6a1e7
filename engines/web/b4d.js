/**
 * Reader of the delivery container b4d in plain JavaScript: typed arrays, fetch, DecompressionStream and crypto.subtle.
 * docs/delivery.md specifies the container. Arrays are planar: all x, then all y, then all z.
 *
 *     const take = await Take.open("person.b4d");
 *     const frame = await take.frame(12);  // {positions: Float32Array(3 N), orientations: Float32Array(4 N), ...}
 */

const MANIFEST = "manifest.json", HEAD_BYTES = 2 ** 16, MAX_MANIFEST_BYTES = 2 ** 26;
const FREE_BYTES = 2 ** 24, MAX_RATIO = 64, FREE_COUNT = 2 ** 18, MAX_FRAMES = 30, LARGEST = 1e6;
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
  return async (name, start, size) => {
    const place = name === null ? url : new URL(name, new URL(url, globalThis.location?.href));
    const answer = await fetch(place, {headers: {Range: `bytes=${start}-${start + size - 1}`}});
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
   * @param {(name: string|null, start: number, size: number) => Promise<Uint8Array>} [read] Reads a range of the file
   *     (name null) or of a file beside the manifest; by default with fetch.
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
    } else if (content.length === HEAD_BYTES) {
      content = await read(null, 0, MAX_MANIFEST_BYTES);
    }
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

  /** Return the arrays of a block, after one request; `entry` is `manifest.static` or one of `manifest.segments`. */
  async tracks(entry, frames) {
    const [name, start] = this.isArchive ? [null, this.start + entry.offset] : [entry.file, 0];
    const packed = await this.read(name, start, entry.bytes);
    require(packed.length === entry.bytes, `${entry.file} must have ${entry.bytes} bytes`, packed.length);
    if (globalThis.crypto?.subtle) { // pages from http have none
      const digest = await crypto.subtle.digest("SHA-256", packed);
      const digits = Array.from(new Uint8Array(digest), (byte) => byte.toString(16).padStart(2, "0")).join("");
      require(digits === entry.sha256, `${entry.file} must have the digest that ${MANIFEST} says`, digits);
    }
    return split(await inflated(packed, entry), entry.file, frames, this.manifest.count);
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
    const values = mapped(tracks, (track, name) => valuesAt(track, frame, count, this.raw[name]));
    for (const name of Object.keys(values)) if (name !== "turns") found[name] = activated(name, values[name]);
    if (values.turns) turn(found, values.turns, count);
    return found;
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
  for (const {first, frames} of said.segments) {
    following = whole(first, "first", following, following) + whole(frames, "frames", 1, MAX_FRAMES);
  }
  whole(said.frames, "frames", Math.max(following, 1), following);
}

async function inflated(packed, entry) {
  const reader = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate")).getReader();
  const content = new Uint8Array(entry.unpacked);
  let end = 0;
  try {
    for (let part; !(part = await reader.read()).done; end += part.value.length) content.set(part.value, end);
  } catch (error) { // a damaged stream, or more than the manifest says
    throw new DeliveryError(`${entry.file} must unpack to ${entry.unpacked} bytes, got ${error.message}.`);
  }
  require(end === entry.unpacked, `${entry.file} must unpack to ${entry.unpacked} bytes`, end);
  return content;
}

function split(content, file, frames, count) {
  const tracks = {};
  let at = 4 + new DataView(content.buffer).getUint32(0, true);
  try {
    const {arrays} = JSON.parse(new TextDecoder().decode(content.subarray(4, at)));
    for (const {name, planes} of arrays) {
      require(planes.length === COMPONENTS[name], `${file} must hold arrays that are known`, name);
      tracks[name] = planes.map(([summed, plain]) => {
        const columns = 1 + summed.length + plain.length;
        const weights = new Float32Array(content.slice(at, at += 4 * frames * columns).buffer);
        require(weights.every((w) => Math.abs(w) <= LARGEST), `${file}: weights must be at most ${LARGEST}`, name);
        return {sizes: [...summed, ...plain], first: summed.length, columns, weights};
      });
    }
    for (const component of Object.values(tracks).flat()) {
      component.planes = component.sizes.map((size, k) => {
        require(at + size * count <= content.length, `${file} must hold all planes`, content.length);
        return plane(content.subarray(at, at += size * count), count, size, k < component.first);
      });
    }
    require(at === content.length, `${file} must be filled by its planes`, at);
  } catch (error) {
    throw error instanceof DeliveryError ? error : new DeliveryError(`${file} must be a sound block, got ${error.message}.`);
  }
  return tracks;
}

/** Return the whole numbers of a plane: 0, 1, 2, 3, 4 … stand for 0, -1, 1, -2, 2 …. */
function plane(octets, count, size, isSummed) {
  require(size >= 1 && size <= 4, "planes must have 1 to 4 bytes", size);
  const numbers = isSummed || size > 1 ? new Float32Array(count) : new Int8Array(count);
  for (let i = 0, sum = 0; i < count; i++) {
    let code = octets[i];
    for (let order = 1; order < size; order++) code |= octets[order * count + i] << (8 * order);
    const number = (code >>> 1) ^ -(code & 1);
    numbers[i] = isSummed ? (sum = (sum + number) | 0) : number;
  }
  return numbers;
}

/** Return offset plus weights times planes for each component, plus what the static block says. */
function valuesAt(track, frame, count, start) {
  const values = new Float32Array(track.length * count), none = new Int8Array(count);
  track.forEach(({columns, weights, planes, first}, c) => {
    const out = values.subarray(c * count, (c + 1) * count), row = weights.subarray(frame * columns, (frame + 1) * columns);
    const plain = planes.map((_, k) => k).filter((k) => k >= first && row[1 + k]);
    let from = start ? start.subarray(c * count, (c + 1) * count) : out;
    for (let n = 0; n < Math.max(Math.ceil(first / 3), plain.length, 1); n++, from = out) {
      const [a, b, d] = [0, 1, 2].map((j) => (3 * n + j < first ? planes[3 * n + j] : out));
      const [p, q, r] = [1, 2, 3].map((j) => (3 * n + j <= first ? row[3 * n + j] : 0));
      blend(out, from, n ? 0 : row[0], a, b, d, p, q, r, planes[plain[n]] ?? none, row[1 + plain[n]] ?? 0);
    }
  });
  return values;
}

function blend(out, from, offset, a, b, c, p, q, r, plain, s) {
  for (let i = 0; i < out.length; i++) out[i] = from[i] + offset + p * a[i] + q * b[i] + r * c[i] + s * plain[i];
}

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

/** Turn orientations, and normals where there are any, by modified Rodrigues parameters. */
function turn(arrays, turns, count) {
  const from = arrays.orientations, to = new Float32Array(4 * count), normals = arrays.normals;
  const turned = normals && new Float32Array(3 * count);
  for (let i = 0, j = count, k = 2 * count, l = 3 * count; i < count; i++, j++, k++, l++) {
    const s = turns[i] * turns[i] + turns[j] * turns[j] + turns[k] * turns[k], share = 1 / (1 + s);
    const a = 2 * turns[i] * share, b = 2 * turns[j] * share, c = 2 * turns[k] * share, d = (1 - s) * share;
    const x = from[i], y = from[j], z = from[k], w = from[l];
    to[i] = d * x + a * w + b * z - c * y, to[j] = d * y + b * w + c * x - a * z;
    to[k] = d * z + c * w + a * y - b * x, to[l] = d * w - a * x - b * y - c * z;
    if (!normals) continue;
    const u = normals[i], v = normals[j], n = normals[k];
    const p = 2 * (b * n - c * v), q = 2 * (c * u - a * n), r = 2 * (a * v - b * u);
    turned[i] = u + d * p + b * r - c * q, turned[j] = v + d * q + c * p - a * r, turned[k] = n + d * r + a * q - b * p;
  }
  arrays.orientations = to;
  if (normals) arrays.normals = turned;
}
