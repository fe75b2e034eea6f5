#!/usr/bin/env bash
# Package: @adobe/spz 0.2.3 (npm), Niantic's SPZ library as WebAssembly, conversion between named axes.
# Expected: RFD is x right, y front, z down, as its letters and its README say. A point 1 to the front, (0, 1, 0),
#   is (0, 0, 1) in RDF (x right, y down, z front).
# Behaviour: the point comes out behind, at (0, 0, -1), and one below comes out above. So it is of the four systems
#   LFD, RFD, LBU and RBU; of the other four with y to front or back (RFU and RBD among them) the letters hold.
# Output seen:
#   RFU front -> RDF: (0, 0, 1)
#   RFU up -> RDF: (0, -1, 0)
#   RFD front -> RDF: (0, 0, -1)
#   RFD down -> RDF: (0, -1, 0)
#   RBU back -> RDF: (0, 0, 1)
#   RBU up -> RDF: (0, 1, 0)
#   against the letters, as recorded
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm init -y >/dev/null
npm install --silent --no-audit --no-fund --ignore-scripts @adobe/spz@0.2.3 >/dev/null 2>&1
cat > axes.mjs <<'SCRIPT'
import make from '@adobe/spz';

const spz = await make({ print: () => {}, printErr: () => {} });
const systems = spz.CoordinateSystem;

/** Where the library takes a point of some axes, in RDF. */
function moved(axes, point) {
  const cloud = {
    numPoints: 1, shDegree: 0, antialiased: false, extensions: [],
    positions: new Float32Array(point), scales: new Float32Array([-3, -3, -3]),
    rotations: new Float32Array([0, 0, 0, 1]), alphas: new Float32Array([1]),
    colors: new Float32Array([0, 0, 0]), sh: new Float32Array(0),
  };
  const file = spz.saveSpzToBuffer(cloud, { version: 4, from: systems[axes], sh1Bits: 5, shRestBits: 4 });
  const back = spz.loadSpzFromBuffer(file, { to: systems.RDF });
  return Array.from(back.positions, (value) => Math.round(value) + 0).join(', ');
}

const tries = [
  ['RFU front', [0, 1, 0], '0, 0, 1'], ['RFU up', [0, 0, 1], '0, -1, 0'],
  ['RFD front', [0, 1, 0], '0, 0, -1'], ['RFD down', [0, 0, 1], '0, -1, 0'],
  ['RBU back', [0, 1, 0], '0, 0, 1'], ['RBU up', [0, 0, 1], '0, 1, 0'],
];
let same = true;
for (const [name, point, recorded] of tries) {
  const found = moved(name.slice(0, 3), point);
  console.log(`${name} -> RDF: (${found})`);
  same &&= found === recorded;
}
console.log(same ? 'against the letters, as recorded' : 'CHANGED: other axes');
process.exit(same ? 0 : 1);
SCRIPT
node axes.mjs
