// What a container costs in JavaScript. Prints it as JSON [ms]: node decode_delivery.mjs FILE.b4d REPEATS

/**
 * Return the lowest and the median cost of a frame [ms]: played on through all segments ("all", "median"), and one of a segment
 * that is not at hand ("random"); "unpack" is the part of unpacking whole segments, as a player does that evaluates frames on the GPU.
 * The first round is not counted.
 * @param {Function} Take
 * @param {Take} opened A take of which no frame has been read.
 * @param {number} repeats
 * @param {() => number} clock Time so far [ms].
 */
export async function decoding(Take, opened, repeats, clock) {
  const {frames, segments} = opened.manifest, closed = () => Object.assign(new Take(), opened);
  const works = {
    all: [frames, async () => { for (let take = closed(), into = {}, k = 0; k < frames; k++) into = await take.frame(k, into); }],
    random: [1, () => closed().frame(Math.floor(frames / 2))],
    unpack: [frames, async () => { for (const entry of segments) await opened.tracks(entry, entry.frames); }],
  };
  const found = {};
  for (let round = 0; round <= repeats; round++) for (const [name, [pieces, work]] of Object.entries(works)) {
    const before = clock();
    await work();
    if (round) (found[name] ??= []).push((clock() - before) / pieces);
  }
  const sorted = found.all.sort((a, b) => a - b);
  return {...Object.fromEntries(Object.entries(found).map(([name, times]) => [name, Math.min(...times)])), median: sorted[Math.floor(repeats / 2)]};
}

if (globalThis.process?.argv[1]?.endsWith("decode_delivery.mjs")) {
  const {open} = await import("node:fs/promises"), {Take} = await import("../engines/web/b4d.js"), file = await open(process.argv[2]);
  const opened = await Take.open("take.b4d", async (name, start, size) => {
    const content = new Uint8Array(size);
    return content.subarray(0, (await file.read(content, 0, size, start)).bytesRead);
  });
  const clock = () => { const {user, system} = process.cpuUsage(); return (user + system) / 1000; };
  console.log(JSON.stringify(await decoding(Take, opened, Number(process.argv[3]), clock)));
  await file.close();
}
