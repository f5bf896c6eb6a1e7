// Prints what a frame of a container costs in Node.js, as JSON [ms]: node decode_delivery.mjs FILE.b4d REPEATS
import {open} from "node:fs/promises";
import {Take} from "../engines/web/b4d.js";

const file = await open(process.argv[2]), repeats = Number(process.argv[3]);
const take = await Take.open("take.b4d", async (name, start, size) => {
  const content = new Uint8Array(size);
  return content.subarray(0, (await file.read(content, 0, size, start)).bytesRead);
});
const entry = take.manifest.segments[0];

async function lowest(count, work) {
  let least = Infinity;
  for (let number = 0; number <= count; number++) {
    const before = process.cpuUsage();
    await work(number);
    if (number) least = Math.min(least, process.cpuUsage(before).user / 1000);
  }
  return least;
}

const unpack = await lowest(repeats, () => take.tracks(entry, entry.frames)) / entry.frames;
const tracks = await take.tracks(entry, entry.frames);
const frame = await lowest(6 * repeats, (number) => take.frameOf(tracks, number % entry.frames));
console.log(JSON.stringify({unpack, frame, all: unpack + frame}));
await file.close();
