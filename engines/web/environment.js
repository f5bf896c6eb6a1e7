/**
 * Light from all around: a Radiance picture (.hdr, RGBE) of the lat-long form, blurred for every roughness.
 *
 * A worker does what beam_warp.light.prefiltered and beam_warp.world.environment do, by the same sums, so that a surface
 * shows the same light. The map itself, which mirrors see, is kept with at most `MAX_ROWS` rows.
 */

/** Light that cannot be read; the message says why. */
export class EnvironmentError extends Error {}

const MAX_ROWS = 1024, MAX_PIXELS = 8192 * 4096;

function require(condition, contract, got) {
  if (!condition) throw new EnvironmentError(`${contract}, got ${String(got).slice(0, 80)}.`);
}

/** Read a Radiance picture: `{width, height, radiance}`, Float32Array of RGB, top row first, scene-linear. */
export function readHdr(bytes) {
  const head = new TextDecoder("latin1").decode(bytes.subarray(0, 65536)), end = head.indexOf("\n\n");
  const size = /^([+-])Y (\d{1,9}) ([+-])X (\d{1,9})\n/.exec(head.slice(end + 2));
  require(head.startsWith("#?") && end >= 0 && size, "environment must be a Radiance picture (.hdr)", JSON.stringify(head.slice(0, 24)));
  const format = /^FORMAT=(.*)$/m.exec(head.slice(0, end))?.[1].trim() ?? "32-bit_rle_rgbe";
  require(format === "32-bit_rle_rgbe", "environment must have FORMAT=32-bit_rle_rgbe", format);
  const exposure = [...head.slice(0, end).matchAll(/^EXPOSURE=(.*)$/gm)].reduce((product, [, value]) => product * Number(value), 1);
  require(exposure > 1e-30 && exposure < 1e30, "environment must have an EXPOSURE in (1e-30, 1e30)", exposure);
  const [height, width] = [Number(size[2]), Number(size[4])];
  require(height >= 4 && width === 2 * height && width * height <= MAX_PIXELS,
    "environment must be twice as wide as high, with 4 to 4096 rows", `${width} x ${height}`);
  require(bytes.length - end - 2 - size[0].length >= 4 * height, "environment must hold every scanline", bytes.length);
  const radiance = new Float32Array(3 * width * height), line = new Uint8Array(4 * width);
  const scale = Float32Array.from({length: 256}, (_, e) => e ? 2 ** (e - 136) / exposure : 0);
  let at = end + 2 + size[0].length;
  for (let y = 0; y < height; y++) {
    at = scanline(bytes, at, width, line);
    require(at > 0, "environment must hold every scanline", `a damaged row ${y}`);
    const row = 3 * width * (size[1] === "-" ? y : height - 1 - y);
    for (let x = 0; x < width; x++) {
      const to = row + 3 * (size[3] === "+" ? x : width - 1 - x);
      for (let c = 0; c < 3; c++) radiance[to + c] = line[4 * x + c] * scale[line[4 * x + 3]];
    }
  }
  require(radiance.every((value) => value < Infinity), "environment must be finite", "infinity");
  return {width, height, radiance};
}

/** Decode a scanline, RGBE by pixel; returns where the next one starts, or -1. */
function scanline(bytes, at, width, line) {
  const isNew = width >= 8 && width <= 32767 && bytes[at] === 2 && bytes[at + 1] === 2 && bytes[at + 2] === width >> 8
    && bytes[at + 3] === (width & 255);
  if (!isNew) return oldScanline(bytes, at, width, line);
  at += 4;
  for (let c = 0; c < 4; c++) {
    for (let x = 0; x < width;) {
      const code = bytes[at++], run = code > 128 ? code - 128 : code;
      if (!run || x + run > width || at + (code > 128 ? 1 : run) > bytes.length) return -1;
      for (let k = 0; k < run; k++, x++) line[4 * x + c] = bytes[code > 128 ? at : at + k];
      at += code > 128 ? 1 : run;
    }
  }
  return at;
}

/** Decode a flat scanline, or one in which (1, 1, 1, n) repeats the pixel before. */
function oldScanline(bytes, at, width, line) {
  for (let x = 0, shift = 0; x < width; at += 4) {
    if (at + 4 > bytes.length) return -1;
    const isRun = bytes[at] === 1 && bytes[at + 1] === 1 && bytes[at + 2] === 1;
    const run = isRun ? bytes[at + 3] * 2 ** shift : 1;
    if (x + run > width || (isRun && (x === 0 || shift > 24))) return -1;
    for (let k = 0; k < run; k++, x++) {
      for (let c = 0; c < 4; c++) line[4 * x + c] = isRun ? line[4 * (x - 1) + c] : bytes[at + c];
    }
    shift = isRun ? shift + 8 : 0;
  }
  return at;
}

/** What a worker runs; it must not use anything outside of itself. */
export function prefilterWorker() {
  const ROOT_ROWS = 4, MAX_TREE_ROWS = 256, OPENING = 0.4, IRRADIANCE_ROWS = 64, TABLE = 64, {PI} = Math;
  const roughnesses = Array.from({length: 12}, (_, k) => 0.125 * 8 ** (k / 11));
  const edgesOf = (rows) => Float64Array.from({length: rows + 1}, (_, k) => -Math.cos(PI * k / rows));
  const evenly = (count) => Float64Array.from({length: count + 1}, (_, k) => k / count);

  /** Return for each new interval the old ones that it overlaps, and shares of it: [first, share, share, …]. */
  function overlaps(old, fresh) {
    const found = [];
    for (let n = 0, o = 0; n < fresh.length - 1; n++) {
      while (o > 0 && old[o] > fresh[n]) o--;
      while (o < old.length - 2 && old[o + 1] <= fresh[n]) o++;
      const row = [o];
      for (let k = o; k < old.length - 1 && (k === o || old[k] < fresh[n + 1]); k++) {
        row.push(Math.max(Math.min(old[k + 1], fresh[n + 1]) - Math.max(old[k], fresh[n]), 0) / (fresh[n + 1] - fresh[n]));
      }
      found.push(row);
    }
    return found;
  }

  /** Return a map on another grid: each texel is the mean over its solid angle. */
  function resized({height, radiance}, rows) {
    if (rows === height) return {height, radiance};
    const down = overlaps(edgesOf(height), edgesOf(rows)), across = overlaps(evenly(2 * height), evenly(2 * rows));
    const narrow = new Float64Array(3 * height * 2 * rows), out = new Float32Array(3 * rows * 2 * rows);
    for (let y = 0; y < height; y++) for (let x = 0; x < 2 * rows; x++) {
      const [first, ...shares] = across[x];
      for (let c = 0; c < 3; c++) {
        let sum = 0;
        for (let k = 0; k < shares.length; k++) sum += shares[k] * radiance[3 * (y * 2 * height + first + k) + c];
        narrow[3 * (y * 2 * rows + x) + c] = sum;
      }
    }
    for (let y = 0; y < rows; y++) {
      const [first, ...shares] = down[y];
      for (let i = 0; i < 6 * rows; i++) {
        let sum = 0;
        for (let k = 0; k < shares.length; k++) sum += shares[k] * narrow[6 * rows * (first + k) + i];
        out[6 * rows * y + i] = sum;
      }
    }
    return {height: rows, radiance: out};
  }

  /** Sum blocks of 2 x 2 cells of `parts` numbers. */
  function halved(cells, rows, parts) {
    const out = new Float64Array(cells.length / 4);
    for (let y = 0; y < rows; y++) for (let x = 0; x < 2 * rows; x++) for (let p = 0; p < parts; p++) {
      out[((y >> 1) * rows + (x >> 1)) * parts + p] += cells[(y * 2 * rows + x) * parts + p];
    }
    return out;
  }

  function directionOf(y, x, rows) {
    const theta = (y + 0.5) * PI / rows, phi = PI - (x + 0.5) * PI / rows;
    return [Math.sin(theta) * Math.cos(phi), Math.sin(theta) * Math.sin(phi), Math.cos(theta)];
  }

  /** Return the quadtree that is blurred, depth first: rows of direction, flux direction, flux, solid angle, size, next. */
  function treeOf(map) {
    const rows = Math.min(Math.max(2 ** Math.floor(Math.log2(map.height)), ROOT_ROWS), MAX_TREE_ROWS);
    const {radiance} = resized(map, rows), depth = Math.log2(rows / ROOT_ROWS), levels = [];
    let cells = new Float64Array(10 * 2 * rows * rows); // flux, its moment, direction times solid angle, solid angle
    for (let y = 0; y < rows; y++) {
      const angle = (Math.cos(PI * y / rows) - Math.cos(PI * (y + 1) / rows)) * PI / rows;
      for (let x = 0; x < 2 * rows; x++) {
        const d = directionOf(y, x, rows), at = 10 * (y * 2 * rows + x), from = 3 * (y * 2 * rows + x);
        const total = angle * (radiance[from] + radiance[from + 1] + radiance[from + 2]);
        for (let c = 0; c < 3; c++) {
          cells[at + c] = angle * radiance[from + c], cells[at + 3 + c] = total * d[c], cells[at + 6 + c] = angle * d[c];
        }
        cells[at + 9] = angle;
      }
    }
    for (let level = depth, side = rows; level >= 0; level--, side /= 2) {
      levels[level] = {cells, side};
      if (level) cells = halved(cells, side, 10);
    }
    const subtree = levels.map((_, level) => (4 ** (depth - level + 1) - 1) / 3);
    const tree = new Float64Array(12 * 2 * ROOT_ROWS * ROOT_ROWS * subtree[0]);
    const unit = (cells, at, other) => {
      const length = Math.hypot(cells[at], cells[at + 1], cells[at + 2]);
      return length > 0 ? [0, 1, 2].map((c) => cells[at + c] / length) : other;
    };
    const lay = (level, y, x, place) => {
      const {cells, side} = levels[level], at = 10 * (y * 2 * side + x), to = 12 * place;
      const direction = unit(cells, at + 6), step = PI / side;
      const widest = Math.max(Math.sin(step * y), Math.sin(step * (y + 1))) * step;
      tree.set([...direction, ...unit(cells, at + 3, direction), ...cells.subarray(at, at + 3), cells[at + 9],
        level === depth ? 0 : widest * widest + step * step, place + subtree[level]], to);
      if (level === depth) return;
      for (let k = 0; k < 4; k++) lay(level + 1, 2 * y + (k >> 1), 2 * x + (k & 1), place + 1 + k * subtree[level + 1]);
    };
    for (let k = 0; k < 2 * ROOT_ROWS * ROOT_ROWS; k++) lay(0, Math.floor(k / (2 * ROOT_ROWS)), k % (2 * ROOT_ROWS), k * subtree[0]);
    return tree;
  }

  /** Return a level: the tree blurred by the lobe of one roughness. */
  function blurred(tree, roughness, rows) {
    const alpha = roughness * roughness, growth = OPENING * OPENING / (2 * alpha), largest = 0.04 / alpha;
    const smallest = Math.min((OPENING * 2 * alpha) ** 2, largest), out = new Float32Array(6 * rows * rows), count = tree.length;
    const lobe = (square) => {
      const cosine = 1 - 0.5 * square, sine = 0.25 * square, below = sine + (1 - sine) * alpha * alpha;
      return cosine > 0 ? cosine / (below * below) : 0;
    };
    for (let y = 0, to = 0; y < rows; y++) for (let x = 0; x < 2 * rows; x++, to += 3) {
      const [dx, dy, dz] = directionOf(y, x, rows);
      let r = 0, g = 0, b = 0, weight = 0;
      for (let at = 0; at < count;) {
        const u = dx - tree[at], v = dy - tree[at + 1], w = dz - tree[at + 2], square = u * u + v * v + w * w;
        if (tree[at + 10] > Math.min(Math.max(growth * square * Math.sqrt(square), smallest), largest)) {
          at += 12;
          continue;
        }
        const p = dx - tree[at + 3], q = dy - tree[at + 4], s = dz - tree[at + 5], share = lobe(p * p + q * q + s * s);
        r += tree[at + 6] * share, g += tree[at + 7] * share, b += tree[at + 8] * share;
        weight += tree[at + 9] * lobe(square);
        at = 12 * tree[at + 11];
      }
      out[to] = r / weight, out[to + 1] = g / weight, out[to + 2] = b / weight;
    }
    return out;
  }

  /** Return irradiance: first moments of cells, exact for those on one side of a normal's horizon. */
  function irradianceOf(map) {
    const rows = IRRADIANCE_ROWS, fine = resized(map, Math.max(Math.ceil(map.height / rows), 2) * rows), split = fine.height / rows;
    const moments = new Float64Array(9 * 2 * rows * rows), out = new Float32Array(6 * rows * rows), step = PI / fine.height;
    for (let y = 0; y < fine.height; y++) {
      const a = step * y, b = step * (y + 1), side = 2 * Math.sin(step / 2) * ((b - a) / 2 - (Math.sin(2 * b) - Math.sin(2 * a)) / 4);
      const up = step * (Math.sin(b) ** 2 - Math.sin(a) ** 2) / 2;
      for (let x = 0; x < 2 * fine.height; x++) {
        const phi = PI - (x + 0.5) * step, m = [side * Math.cos(phi), side * Math.sin(phi), up];
        const to = 9 * (Math.floor(y / split) * 2 * rows + Math.floor(x / split)), from = 3 * (y * 2 * fine.height + x);
        for (let c = 0; c < 3; c++) for (let k = 0; k < 3; k++) moments[to + 3 * c + k] += fine.radiance[from + c] * m[k];
      }
    }
    for (let y = 0, to = 0; y < rows; y++) for (let x = 0; x < 2 * rows; x++, to += 3) {
      const [u, v, w] = directionOf(y, x, rows);
      let r = 0, g = 0, b = 0;
      for (let at = 0; at < moments.length; at += 9) {
        r += Math.max(0, moments[at] * u + moments[at + 1] * v + moments[at + 2] * w);
        g += Math.max(0, moments[at + 3] * u + moments[at + 4] * v + moments[at + 5] * w);
        b += Math.max(0, moments[at + 6] * u + moments[at + 7] * v + moments[at + 8] * w);
      }
      out[to] = r, out[to + 1] = g, out[to + 2] = b;
    }
    return out;
  }

  /** Return the terms (A, B) of the specular albedo, as beam_warp.light.ggx integrates them. */
  function albedoTable() {
    const table = new Float32Array(2 * TABLE * TABLE), AROUND = 32, ACROSS = 64;
    const around = Float64Array.from({length: AROUND}, (_, i) => Math.cos((i + 0.5) * PI / AROUND)); // a power or a cosine inside takes seconds
    const mean = Array.from({length: ACROSS}, (_, k) => 3 * (1 - (k + 0.5) / ACROSS) ** 2).reduce((a, b) => a + b) / ACROSS;
    for (let row = 0; row < TABLE; row++) for (let column = 0; column < TABLE; column++) {
      const cosine = Math.max((column / (TABLE - 1)) ** 2, 1e-6), sine = Math.sqrt(1 - cosine * cosine), alpha = (row / (TABLE - 1)) ** 2;
      const length = Math.hypot(alpha * sine, cosine), x = alpha * sine / length, z = cosine / length;
      const lambda = (c) => 0.5 * (Math.sqrt(1 + alpha * alpha * (1 / (c * c) - 1)) - 1), view = 1 + lambda(cosine);
      let a = 0, b = 0;
      for (let k = 0; k < ACROSS; k++) {
        const left = 1 - (k + 0.5) / ACROSS, height = left * left * left * (1 + z) - z, weight = 3 * left * left / mean;
        const ring = Math.sqrt(Math.max(1 - height * height, 0));
        for (let i = 0; i < AROUND; i++) {
          const along = ring * around[i] + x, p = alpha * along, s = height + z, across = ring * ring * (1 - around[i] * around[i]);
          const size = Math.sqrt(p * p + alpha * alpha * across + s * s), vh = (sine * p + cosine * s) / size, nl = 2 * vh * s / size - cosine;
          if (!(nl > 0)) continue;
          const off = 1 - vh, masking = weight * view / (view + lambda(nl)), rising = off * off * off * off * off;
          a += masking * (1 - rising), b += masking * rising;
        }
      }
      table.set([a / (AROUND * ACROSS), b / (AROUND * ACROSS)], 2 * (row * TABLE + column));
    }
    return table;
  }

  /** Cut a map into regions of little blur, as beam_warp.light.regions does: where each is, how wide, and its moments. */
  function regionsOf(map, count) {
    const {height: rows, radiance} = resized(map, Math.min(map.height, 256)), columns = 2 * rows;
    const power = new Float64Array(rows * columns), angleOf = (y) => PI / rows * (Math.cos(PI * y / rows) - Math.cos(PI * (y + 1) / rows));
    const weigh = (isDark) => power.forEach((_, i) => {
      const light = 0.2126 * radiance[3 * i] + 0.7152 * radiance[3 * i + 1] + 0.0722 * radiance[3 * i + 2];
      power[i] = (isDark ? 1 : light) * angleOf(Math.floor(i / columns));
    });
    weigh(false);
    if (!power.some((value) => value > 0)) weigh(true);
    const each = ([top, bottom, left, right], visit) => { for (let y = top; y < bottom; y++) for (let x = left; x < right; x++) visit(y * columns + x, y, x); };
    const light = new Float64Array(4 * power.length), total = power.reduce((sum, value) => sum + value); // share of power, and times direction
    each([0, rows, 0, columns], (i, y, x) => light.set([1, ...directionOf(y, x, rows)].map((value) => value * power[i] / total), 4 * i));
    /** Return the first of the largest gains: mirror images gain alike, whatever their rounding. */
    const firstBest = (cuts) => {
      const most = cuts.reduce((found, {gain}) => Math.max(found, gain), -1);
      return cuts.findIndex(({gain}) => gain >= most - 1e-6);
    };
    /** Return power times the standard deviation of directions between two places of running sums. */
    const blur = (sums, from, to) => {
      const [all, ...d] = [0, 1, 2, 3].map((c) => sums[4 * to + c] - sums[4 * from + c]);
      return Math.sqrt(Math.max(all * all - d[0] * d[0] - d[1] * d[1] - d[2] * d[2], 0));
    };
    /** Find the cut that takes most off a box's blur; one of a single texel stays, beside an empty one. */
    const bestCut = (box) => {
      const [top, bottom, left, right] = box, found = [];
      const sums = [bottom - top, right - left].map((size) => new Float64Array(4 * size + 4));
      each(box, (i, y, x) => {
        for (let c = 0; c < 4; c++) sums[0][4 * (y - top + 1) + c] += light[4 * i + c], sums[1][4 * (x - left + 1) + c] += light[4 * i + c];
      });
      for (const one of sums) for (let k = 4; k < one.length; k++) one[k] += one[k - 4];
      sums.forEach((one, across) => {
        const end = one.length / 4 - 1, whole = blur(one, 0, end);
        for (let k = 1; k < end; k++) found.push({gain: whole - blur(one, 0, k) - blur(one, k, end), across, k});
      });
      if (!found.length) return {box, gain: -1, halves: [box, [bottom, bottom, left, right]]};
      const {gain, across, k} = found[firstBest(found)];
      return {box, gain, halves: across ? [[top, bottom, left, left + k], [top, bottom, left + k, right]]
        : [[top, top + k, left, right], [top + k, bottom, left, right]]};
    };
    const cuts = [bestCut([0, rows, 0, columns])];
    while (cuts.length < count) {
      const most = firstBest(cuts);
      cuts.splice(most, 1, ...cuts[most].halves.map(bestCut));
    }
    return cuts.map(({box}) => {
      let total = 0, inside = 0, isLit = false;
      const mean = [0, 0, 0], flux = [0, 0, 0], sums = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
      each(box, (i) => { inside++; isLit ||= power[i] > 0; });
      each(box, (i, y, x) => {
        const d = directionOf(y, x, rows), weight = isLit ? power[i] : 1, angle = angleOf(y);
        total += weight;
        for (let k = 0; k < 3; k++) mean[k] += weight * d[k];
        for (let c = 0; c < 3; c++) {
          const light = radiance[3 * i + c] * angle;
          flux[c] += light;
          for (let k = 0; k < 3; k++) sums[c][k] += light * d[k];
        }
      });
      const length = Math.hypot(...mean), direction = length > 1e-9 * Math.max(total, 1e-300) ? mean.map((value) => value / length) : [0, 0, 1];
      const cosine = inside ? (mean[0] * direction[0] + mean[1] * direction[1] + mean[2] * direction[2]) / total : 1;
      const moments = sums.map((sum, c) => {
        const size = Math.hypot(...sum);
        return [...sum, size * Math.sqrt(3 * Math.max(1 - size / Math.max(flux[c], 1e-300), 0))];
      });
      return {direction, halfAngle: Math.acos(Math.min(Math.max(2 * cosine - 1, Math.cos(75 * PI / 180)), 1)), moments};
    });
  }

  return ({map, most, regions}) => {
    if (!map) return {albedo: albedoTable()};
    if (regions) return {regions: regionsOf(map, regions)};
    const tree = treeOf(map), finest = Math.min(MAX_TREE_ROWS, Math.max(32, 2 * map.height));
    const first = map.height > most ? resized(map, most) : map;
    const levels = roughnesses.map((roughness) => {
      const height = Math.min(Math.max(Math.ceil(PI / (0.8 * roughness * roughness)), 32), finest);
      return {height, radiance: blurred(tree, roughness, height)};
    });
    const irradiance = {height: IRRADIANCE_ROWS, radiance: irradianceOf(map)};
    return {maps: [irradiance, {height: first.height, radiance: first.radiance}, ...levels]};
  };
}

/**
 * Run a function that returns a handler in a worker, or here if workers are refused; returns {ask(message), end()}. Memory
 * that an answer lists as `transfer` is handed over, not copied.
 */
export function inWorker(maker, ...needed) {
  let worker;
  try {
    const source = `const handle = (${maker})(${needed.map((each) => `(${each})()`)}); onmessage = async ({data: [number, message]}) => {
      try { const answer = await handle(message); postMessage([number, answer], answer?.transfer ?? []); }
      catch (error) { postMessage([number, null, String(error?.message || error)]); } };`;
    const url = URL.createObjectURL(new Blob([source], {type: "text/javascript"}));
    worker = new Worker(url);
    URL.revokeObjectURL(url);
  } catch { // a page's policy
    const handle = maker(...needed.map((each) => each()));
    return {ask: async (message) => handle(message), end() {}};
  }
  const waiting = new Map();
  let last = 0;
  worker.onmessage = ({data: [number, answer, error]}) => {
    const {resolve, reject} = waiting.get(number);
    waiting.delete(number);
    if (error) reject(new Error(error));
    else resolve(answer);
  };
  return {
    ask: (message) => new Promise((resolve, reject) => {
      waiting.set(++last, {resolve, reject});
      worker.postMessage([last, message]);
    }),
    end: () => {
      worker.terminate();
      for (const {reject} of waiting.values()) reject(new Error("the worker was ended"));
    },
  };
}

/** Return what was promised under a name; make it if nothing was, or if that came to nothing. */
function kept(promises, name, make) {
  return promises[name] ??= make().catch((error) => {
    delete promises[name];
    throw error;
  });
}

/** An environment that is ready to light: its irradiance, the map, and the levels of roughness, one below the other. */
export class Environment {
  /** Read a picture from its address or from its bytes, and blur it. */
  static async load(from) {
    let bytes = from;
    if (typeof from === "string" || from instanceof URL) {
      const answer = await fetch(from);
      require(answer.ok, `${from} must be within reach`, answer.status);
      bytes = await answer.arrayBuffer();
    }
    return Environment.of(readHdr(bytes instanceof Uint8Array ? bytes : new Uint8Array(bytes)));
  }

  /** Blur a map: `{height, radiance}`, Float32Array of RGB, twice as wide as high. */
  static async of(map) {
    const [made, table] = await Promise.all([Environment.made({map: {height: map.height, radiance: map.radiance}, most: MAX_ROWS}), Environment.table()]);
    return Object.assign(made, table);
  }

  /** Return a number of regions of little blur: `{direction, halfAngle, moments}` each, in the environment's own axes. */
  async regions(count) {
    return (await kept(this.cuts ??= {}, count, () => Environment.made({map: this.maps[1], regions: count}))).regions;
  }

  /** Return light of one radiance from everywhere; without arguments, darkness. */
  static async constant(rgb = [0, 0, 0]) {
    const even = (gain) => ({height: 4, radiance: Float32Array.from({length: 96}, (_, k) => gain * rgb[k % 3])});
    return Object.assign(new Environment(), await Environment.table(), {maps: [even(Math.PI), ...Array(13).fill(even(1))]});
  }

  /** Return the terms of the specular albedo, which all environments share; the first time a worker finds them. */
  static table() {
    return kept(Environment, "shared", () => Environment.made({}));
  }

  static async made(message) {
    const worker = inWorker(prefilterWorker);
    try {
      return Object.assign(new Environment(), await worker.ask(message));
    } finally {
      worker.end();
    }
  }
}
