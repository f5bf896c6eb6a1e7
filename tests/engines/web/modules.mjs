// What the module computes without a browser, for tests/engines/web/test_modules.py: reads a job from stdin.
import {readFileSync} from "node:fs";
import {Take} from "../../../engines/web/b4d.js";
import {Environment, prefilterWorker, readHdr} from "../../../engines/web/environment.js";
import {checkedLights, lampNumbers, mapNumbers, shadowViews} from "../../../engines/web/lights.js";
import {sortingWorker} from "../../../engines/web/sorting.js";
import {inflating} from "../../../engines/web/inflate.js";
import {Segments} from "../../../engines/web/segments.js";
import {toWgsl} from "../../../engines/web/gpu.js";

const floats = (list) => Float32Array.from(list);
const jobs = {
  hdr: ({path}) => {
    const {width, height, radiance} = readHdr(new Uint8Array(readFileSync(path)));
    return {width, height, radiance: Array.from(radiance)};
  },
  prefilter: ({height, radiance}) => {
    const handle = prefilterWorker(), {albedo} = handle({}), {maps} = handle({map: {height, radiance: floats(radiance)}, most: 1024});
    return {maps: maps.map((map) => ({height: map.height, radiance: Array.from(map.radiance)})), albedo: Array.from(albedo)};
  },
  regions: ({height, radiance, count}) => prefilterWorker()({map: {height, radiance: floats(radiance)}, regions: count}),
  /** Ask for what a worker makes, which fails the first time it is asked; says how each request ended, and how often it was asked. */
  retry: async () => {
    let count = 0;
    Environment.made = async () => {
      if (!count++) throw new Error("no worker");
      return {regions: [count]};
    };
    const light = Object.assign(new Environment(), {maps: []}), ended = [];
    for (const ask of [() => Environment.table(), () => light.regions(4)]) {
      count = 0;
      for (let k = 0; k < 3; k++) ended.push(await ask().then(() => "made", (error) => error.message));
      ended.push(count);
    }
    return ended;
  },
  lights: ({lights, casters, size}) => checkedLights(lights).map((light) => {
    const views = shadowViews(light, casters, size);
    return {lamp: lampNumbers(light, 0, views.length), maps: views.map((view) => mapNumbers(view, 0.01))};
  }),
  sort: ({positions, opacities, rows, plane, weight}) => {
    const count = opacities.length, handle = sortingWorker();
    handle({still: floats(positions), opacities: floats(opacities), count, row: 16});
    handle({segment: 0, planes: [[floats(plane)], [], []]});
    const at = {frame: "0", segment: 0, heads: [0, 0, 0], terms: [[[0, weight]], [], []]};
    const {orders, bulk} = handle({at, views: rows, bulk: true});
    return {orders: orders.map((order) => Array.from(order.subarray(0, count))), bulk};
  },
  /** Return what streams unpack to, null where they are damaged; throws if signed octets are others. */
  inflate: ({streams}) => {
    const {inflate, inflated, SPARE} = inflating();
    return streams.map(([text, end, most]) => {
      const packed = Buffer.from(text, "base64"), room = new Uint8Array(most + SPARE);
      let octets;
      try { octets = inflated(packed, 0, end, most); } catch { return null; }
      const count = inflate(packed, 0, end, room, true), signed = new Int8Array(room.buffer, 0, count);
      if (count !== octets.length || signed.some((number, i) => number !== (octets[i] & 1 ? -(octets[i] + 1) / 2 : octets[i] / 2))) throw new Error("signed");
      return Buffer.from(octets).toString("base64");
    });
  },
  take: async ({path}) => {
    const bytes = readFileSync(path), take = await Take.from(bytes);
    return (await take.frame(take.manifest.frames - 1)).positions.length;
  },
  damage: async ({path, cuts, flips}) => {
    const whole = readFileSync(path), cut = cuts.map((at) => whole.subarray(0, at));
    const changed = flips.map((at) => Uint8Array.from(whole, (byte, i) => i === at ? byte ^ 255 : byte)), found = [];
    for (const bytes of [whole, ...cut, ...changed]) {
      try {
        const take = await Take.from(bytes);
        for (let frame = 0; frame < take.manifest.frames; frame++) await take.frame(frame);
        found.push("whole");
      } catch (error) {
        found.push(error.constructor.name);
      }
    }
    return found;
  },
  /** Play a take of six segments of ten frames, of which each step wants one; says what is here, and what happened. */
  segments: async ({most, steps}) => {
    const broken = new Set(), waiting = [], told = [], unpacked = [];
    let clock = 0, isSlow = false;
    globalThis.performance = {now: () => clock};
    const entries = Array.from({length: 6}, (_, k) => ({first: 10 * k, frames: 10, file: `${k}`}));
    const take = {manifest: {segments: entries}, async tracks({file}, _, unpack, signal) {
      if (isSlow) await new Promise((resolve, reject) => { waiting.push(resolve); signal.addEventListener("abort", () => reject(new Error("aborted"))); });
      if (broken.has(Number(file))) throw new Error("out of reach");
      return (await unpack(file)).tracks;
    }};
    const owner = {most, store: async (number, entry) => { unpacked.push(number); return {number, entry, bytes: 100}; }, free() {},
      tell: (type, {segment}) => told.push(`${type} ${segment}`)};
    const segments = new Segments(take, owner, {ask: async () => ({tracks: {}}), end() {}}), answers = [];
    const settle = () => new Promise((resolve) => setTimeout(resolve, 1));
    for (const {want, breaks, mends, passes = 0, slow, flows, nearest} of steps) {
      clock += passes;
      isSlow = slow ?? isSlow;
      if (breaks !== undefined) broken.add(breaks);
      if (mends !== undefined) broken.delete(mends);
      if (want !== undefined) segments.want(want);
      if (flows) while (waiting.length) { waiting.shift()(); await settle(); }
      for (let k = 0; k < 9; k++) await settle();
      const place = nearest === undefined ? null : segments.nearest(nearest);
      answers.push({here: entries.map((_, k) => k).filter((k) => segments.has(k)), told: told.splice(0), unpacked: unpacked.splice(0),
        nearest: place && [place.number, place.local, place.distance]});
    }
    return answers;
  },
  wgsl: ({source}) => toWgsl(source),
};
const answers = [];
for (const {job, ...given} of JSON.parse(readFileSync(0, "utf8"))) {
  try {
    answers.push(await jobs[job](given));
  } catch (error) {
    answers.push({error: `${error.constructor.name}: ${error.message}`});
  }
}
process.stdout.write(JSON.stringify(answers));
