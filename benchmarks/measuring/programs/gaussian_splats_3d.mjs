// node gaussian_splats_3d.mjs write IN.ply FILE.ksplat LEVEL
import fs from 'node:fs';
import { createRequire } from 'node:module';
globalThis.window = globalThis;
const viewer = await import(createRequire(process.env.PACKAGES + '/').resolve('@mkkellogg/gaussian-splats-3d'));
const [, from, to, level] = process.argv.slice(2);
const file = fs.readFileSync(from);
const content = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
const splats = viewer.PlyParser.parseToUncompressedSplatArray(content, 2);
const buffer = viewer.SplatBufferGenerator.getStandardGenerator(1, Number(level), 0).generateFromUncompressedSplatArray(splats);
fs.writeFileSync(to, Buffer.from(buffer.bufferData));
