// Prints what a frame of a container costs in Node.js, as JSON [ms]: node decode_delivery.mjs FILE.b4d REPEATS
import {open} from "node:fs/promises";
import {Take} from "../engines/web/b4d.js";

const file = await open(process.argv[2]), repeats = Number(process.argv[3]);
const take = await Take.open("take.b4d", async (name, start, size) => {
  const content = new Uint8Array(size);
  return content.subarray(0, (await file.read(content, 0, size, start)).bytesRead);
});
const entry = take.manifest.segments[0];

/** Return the lowest mean time of the processor in some rounds of work [ms]; its clock is too coarse for one piece. */
async function lowest(pieces, work) {
  let least = Infinity;
  for (let round = 0; round <= repeats; round++) {
    const before = process.cpuUsage();
    for (let number = 0; number < pieces; number++) await work(number);
    if (round) least = Math.min(least, process.cpuUsage(before).user / 1000 / pieces);
  }
  return least;
}

const unpack = await lowest(2, () => take.tracks(entry, entry.frames)) / entry.frames;
const tracks = await take.tracks(entry, entry.frames);
const frame = await lowest(entry.frames, (number) => take.frameOf(tracks, number));
console.log(JSON.stringify({unpack, frame, all: unpack + frame}));
await file.close();
