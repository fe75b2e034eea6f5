// The format's own library, in WebAssembly. node adobe_spz.mjs read FILE.spz OUT.json | write IN.json FILE.spz VERSION
import fs from 'node:fs';
import { createRequire } from 'node:module';
const entry = createRequire(process.env.PACKAGES + '/').resolve('@adobe/spz');
const { default: load } = await import(entry);
const spz = await load({ print: () => {}, printErr: () => {} });
const fields = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'];
const [verb, from, to, version] = process.argv.slice(2);
const axes = spz.CoordinateSystem.RDF; // those of training worlds
if (verb === 'read') {
  const cloud = spz.loadSpzFromBuffer(new Uint8Array(fs.readFileSync(from)), { to: axes });
  const out = { numPoints: cloud.numPoints };
  for (const field of fields) out[field] = Array.from(cloud[field] ?? []);
  fs.writeFileSync(to, JSON.stringify(out));
} else {
  const given = JSON.parse(fs.readFileSync(from));
  const cloud = { numPoints: given.numPoints, shDegree: given.shDegree, antialiased: false, extensions: [] };
  for (const field of fields) cloud[field] = new Float32Array(given[field]);
  fs.writeFileSync(to, spz.saveSpzToBuffer(cloud, { version: Number(version), from: axes, sh1Bits: 5, shRestBits: 4 }));
}
