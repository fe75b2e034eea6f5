#!/usr/bin/env bash
# Packages: @adobe/spz 0.2.3 (Niantic's SPZ library as WebAssembly), spz-js 1.2.5 and @playcanvas/splat-transform 3.7.0
#   (npm), and gsply 0.4.6 (PyPI): four writers of .spz. One reader for all: the first.
# Input: splats at x = 100, 2000, 3000 and 5000, as a sky or a scene in a map's coordinates has them.
# Expected: a position that the format cannot hold is refused, or ends at its border with a warning; the library's
#   README says that positions are fixed-point numbers of 24 bits, and not how far these reach.
# Behaviour: 24 bits reach to 2048. Three writers drop the higher bits: what is farther comes back on the other side, or
#   in the middle of the scene, where it floats in front of everything. gsply moves it to the border. None says a word.
# Output seen:
#   @adobe/spz:       100 2000 -1096 904
#   spz-js:           100 2000 -1096 904
#   splat-transform:  100 2000 -1096 904
#   gsply:            100 2000 2048 2048
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm init -y >/dev/null
npm install --silent --no-audit --no-fund --ignore-scripts \
  @adobe/spz@0.2.3 spz-js@1.2.5 @playcanvas/splat-transform@3.7.0 >/dev/null 2>&1
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check gsply==0.4.6 numpy==2.2.6
cat > write.mjs <<'SCRIPT'
import { writeFileSync } from 'node:fs';
import make from '@adobe/spz';
import { serializePly, serializeSpz } from 'spz-js';

const spz = await make({ print: () => {}, printErr: () => {} });
const places = [100, 2000, 3000, 5000];
const cloud = {
  numPoints: 4, shDegree: 0, antialiased: false, extensions: [],
  positions: new Float32Array(places.flatMap((x) => [x, 0, 0])), scales: new Float32Array(12).fill(-3),
  rotations: new Float32Array([0, 1, 2, 3].flatMap(() => [0, 0, 0, 1])), alphas: new Float32Array(4).fill(1),
  colors: new Float32Array(12), sh: new Float32Array(0),
};
writeFileSync('model.ply', Buffer.from(serializePly(cloud)));
writeFileSync('spz-js.spz', await serializeSpz(cloud));
const options = { version: 3, from: spz.CoordinateSystem.RUB, sh1Bits: 5, shRestBits: 4 };
writeFileSync('@adobe+spz.spz', spz.saveSpzToBuffer(cloud, options));
SCRIPT
cat > read.mjs <<'SCRIPT'
import { readFileSync } from 'node:fs';
import make from '@adobe/spz';

const spz = await make({ print: () => {}, printErr: () => {} });
const wrapped = '100 2000 -1096 904';
const recorded = { '@adobe/spz': wrapped, 'spz-js': wrapped, 'splat-transform': wrapped, gsply: '100 2000 2048 2048' };
let same = true;
for (const [writer, expected] of Object.entries(recorded)) {
  const file = readFileSync(`${writer.replace('/', '+')}.spz`);
  const { positions } = spz.loadSpzFromBuffer(file, { to: spz.CoordinateSystem.RUB });
  const found = [0, 3, 6, 9].map((index) => Math.round(positions[index])).join(' ');
  console.log(`${writer}:`.padEnd(17), found);
  same &&= found === expected;
}
process.exit(same ? 0 : 1);
SCRIPT
node write.mjs
node node_modules/@playcanvas/splat-transform/bin/cli.mjs -q -w model.ply splat-transform.spz
venv/bin/python -c 'import gsply, gsply.spz; gsply.spz.write_spz("gsply.spz", gsply.plyread("model.ply"))'
node read.mjs
