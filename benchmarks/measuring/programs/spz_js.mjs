// node spz_js.mjs read FILE.spz OUT.ply | write IN.ply FILE.spz
import fs from 'node:fs';
import { Readable } from 'node:stream';
import { createRequire } from 'node:module';
const { loadSpz, serializePly, loadPly, serializeSpz } = await import(createRequire(process.env.PACKAGES + '/').resolve('spz-js'));
const [verb, from, to] = process.argv.slice(2);
const content = verb === 'read'
  ? serializePly(await loadSpz(fs.readFileSync(from)))
  : await serializeSpz(await loadPly(Readable.toWeb(fs.createReadStream(from))));
fs.writeFileSync(to, Buffer.from(content));
