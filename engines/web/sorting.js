/** Depth order of Gaussians, seen from a camera and from the lamps: in a worker, so that the page stays at hand. */

import {inWorker} from "./environment.js";

/** What the worker runs; it must not use anything outside of itself. */
export function sortingWorker() {
  const segments = new Map();
  let still, opacities, count = 0, row = 0, positions, key = null;
  const bits = new Uint32Array(1), number = new Float32Array(bits.buffer);

  /** Return indices by rising key, equal keys in their order: two rounds of 16 bits. */
  function sorted(keys) {
    const from = new Uint32Array(keys.length), to = new Uint32Array(keys.length);
    for (let i = 0; i < from.length; i++) from[i] = i;
    byHalf(keys, from, to, 0);
    byHalf(keys, to, from, 16);
    return from;
  }

  /** Lay indices into another array by 16 bits of their keys. */
  function byHalf(keys, from, to, shift) {
    const starts = new Uint32Array(65537);
    for (let i = 0; i < keys.length; i++) starts[((keys[i] >>> shift) & 65535) + 1]++;
    for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
    for (let i = 0; i < keys.length; i++) to[starts[(keys[from[i]] >>> shift) & 65535]++] = from[i];
  }

  // One loop for each kind of array: one that meets another kind is compiled anew, which a first seek would wait for.
  const addNumbers = (out, weight, values) => { for (let i = 0; i < out.length; i++) out[i] += weight * values[i]; };
  const addOctets = (out, weight, values) => { for (let i = 0; i < out.length; i++) out[i] += weight * values[i]; };

  /** Evaluate positions, axes of the container. */
  function evaluate({frame, segment, heads, terms}) {
    if (key === frame) return;
    key = frame;
    for (let c = 0; c < 3; c++) {
      const out = positions.subarray(c * count, (c + 1) * count);
      out.set(still.subarray(c * count, (c + 1) * count));
      if (heads[c]) for (let i = 0; i < count; i++) out[i] += heads[c];
      for (const [plane, weight] of terms[c]) {
        const values = segments.get(segment)[c][plane];
        (values instanceof Int8Array ? addOctets : addNumbers)(out, weight, values);
      }
    }
  }

  /** Return the nearest first, as numbers of a texture's texels. */
  function order([a, b, c, d]) {
    const depths = new Float32Array(count), keys = new Uint32Array(depths.buffer);
    for (let i = 0; i < count; i++) {
      const depth = a * positions[i] + b * positions[count + i] + c * positions[2 * count + i] + d;
      depths[i] = depth > 0 ? depth : Infinity;
    }
    const found = new Float32Array(row * Math.max(Math.ceil(count / row), 1));
    found.set(sorted(keys));
    return found;
  }

  /** Return the middle and radius of what belongs to the subject: beam_warp.world.framing.bulk, and the sphere around it. */
  function bulk() {
    const inside = new Uint8Array(count).fill(1), keys = new Uint32Array(count), low = [0, 0, 0], high = [0, 0, 0];
    let total = 0;
    for (let i = 0; i < count; i++) total += opacities[i];
    const weigh = total > 0 ? (i) => opacities[i] : () => 1;
    if (!(total > 0)) total = count;
    for (let c = 0; c < 3; c++) {
      const values = positions.subarray(c * count, (c + 1) * count);
      for (let i = 0; i < count; i++) {
        number[0] = values[i];
        keys[i] = bits[0] & 0x80000000 ? ~bits[0] : bits[0] | 0x80000000;
      }
      const places = sorted(keys);
      let share = 0, first = null, last = null;
      for (let k = 0; k < count && last === null; k++) {
        share += weigh(places[k]);
        if (first === null && share >= 0.01 * total) first = values[places[k]];
        if (share >= 0.99 * total) last = values[places[k]];
      }
      last ??= values[places[count - 1]];
      const grown = 0.25 * (last - first);
      for (let i = 0; i < count; i++) if (!(values[i] >= first - grown && values[i] <= last + grown)) inside[i] = 0;
    }
    if (!inside.includes(1)) inside.fill(1);
    for (let c = 0; c < 3; c++) {
      low[c] = Infinity, high[c] = -Infinity;
      for (let i = 0; i < count; i++) if (inside[i]) {
        low[c] = Math.min(low[c], positions[c * count + i]), high[c] = Math.max(high[c], positions[c * count + i]);
      }
    }
    const center = [0, 1, 2].map((c) => count ? 0.5 * (low[c] + high[c]) : 0);
    let square = 0;
    for (let i = 0; i < count; i++) if (inside[i]) {
      let sum = 0;
      for (let c = 0; c < 3; c++) sum += (positions[c * count + i] - center[c]) ** 2;
      square = Math.max(square, sum);
    }
    return {center, radius: Math.max(Math.sqrt(square), 1e-3)};
  }

  return (message) => {
    if (message.still) {
      ({still, opacities, count, row} = message);
      positions = new Float32Array(3 * count);
      key = null;
      segments.clear();
    }
    if (message.segment !== undefined && message.planes) segments.set(message.segment, message.planes);
    if (message.plane) {
      const [c, k, values] = message.plane, planes = segments.get(message.segment);
      if (planes) planes[c][k] = values;
    }
    if (message.drop !== undefined) segments.delete(message.drop);
    if (!message.at) return null;
    evaluate(message.at);
    const orders = (message.views ?? []).map(order);
    return {orders, bulk: message.bulk ? bulk() : null, transfer: orders.map(({buffer}) => buffer)};
  };
}

/** Return a sorter: `ask(message)` as `sortingWorker` takes it, `end()`. */
export const sorter = () => inWorker(sortingWorker);
