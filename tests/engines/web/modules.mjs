// What the module computes without a browser, for tests/engines/web/test_modules.py: reads a job from stdin.
import {readFileSync} from "node:fs";
import {Take} from "../../../engines/web/b4d.js";
import {prefilterWorker, readHdr} from "../../../engines/web/environment.js";
import {checkedLights, lampNumbers, mapNumbers, shadowViews} from "../../../engines/web/lights.js";
import {sortingWorker} from "../../../engines/web/sorting.js";
import {toWgsl} from "../../../engines/web/gpu.js";

const floats = (list) => Float32Array.from(list);
const jobs = {
  hdr: ({path}) => {
    const {width, height, radiance} = readHdr(new Uint8Array(readFileSync(path)));
    return {width, height, radiance: Array.from(radiance)};
  },
  prefilter: ({height, radiance}) => {
    const {maps, albedo} = prefilterWorker()({map: {height, radiance: floats(radiance)}, most: 1024});
    return {maps: maps.map((map) => ({height: map.height, radiance: Array.from(map.radiance)})), albedo: Array.from(albedo)};
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
  take: async ({path}) => {
    const bytes = readFileSync(path), take = await Take.from(bytes);
    return (await take.frame(take.manifest.frames - 1)).positions.length;
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
