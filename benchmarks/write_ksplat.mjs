// Writes a .ksplat by the library of its inventor: node write_ksplat.mjs MODULE IN.ply OUT.ksplat LEVEL DEGREE
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [module, source, target, level, degree] = process.argv.slice(2);
const { PlyParser, SplatBufferGenerator } = await import(pathToFileURL(module));
const splats = PlyParser.parseToUncompressedSplatArray(readFileSync(source).buffer, Number(degree));
const ksplat = SplatBufferGenerator.getStandardGenerator(1, Number(level)).generateFromUncompressedSplatArray(splats);
writeFileSync(target, Buffer.from(ksplat.bufferData));
