#!/usr/bin/env bash
# Package: gaussforge 0.6.0 (PyPI), @mkkellogg/gaussian-splats-3d 0.4.7 (npm), whose own format .ksplat is, and
#   @playcanvas/splat-transform 3.7.0 (npm), another reader of it.
# Expected: a .ksplat that gaussforge writes shows its splats in the viewer that the format comes from.
# Behaviour: gaussforge leaves the header's largest number of splats at 0. The viewer goes by that number and holds no
#   splat, without an error; splat-transform goes by the number of loaded splats and reads all.
# Output seen:
#   header: 0 splats at most, 10 loaded
#   GaussianSplats3D holds 0 of 10 splats
#   splat-transform reads 10 of 10 splats
#   empty for its own viewer, as recorded
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check gaussforge==0.6.0 >/dev/null 2>&1
npm init -y >/dev/null
npm install --silent --no-audit --no-fund --ignore-scripts \
    @mkkellogg/gaussian-splats-3d@0.4.7 three@0.180.0 @playcanvas/splat-transform@3.7.0 >/dev/null 2>&1
cat > write.py <<'PYTHON'
import struct

import gaussforge

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
         "rot_0", "rot_1", "rot_2", "rot_3"]
head = "ply\nformat binary_little_endian 1.0\nelement vertex 10\n"
head += "".join("property float %s\n" % name for name in NAMES) + "end_header\n"
rows = [(i, 0, 0, 0.5, 0.5, 0.5, 2, -3, -3, -3, 1, 0, 0, 0) for i in range(10)]
ply = head.encode() + b"".join(struct.pack("<14f", *row) for row in rows)
made = gaussforge.GaussForge().convert(ply, "ply", "ksplat")
made = bytes(made["data"] if isinstance(made, dict) else made)
open("model.ksplat", "wb").write(made)
most, loaded = struct.unpack_from("<II", made, 12)
print("header: %d splats at most, %d loaded" % (most, loaded))
PYTHON
cat > view.mjs <<'NODE'
import fs from 'fs';
globalThis.window = globalThis;
const { KSplatLoader, SplatBuffer } = await import('@mkkellogg/gaussian-splats-3d');
const file = fs.readFileSync('model.ksplat');
const content = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
KSplatLoader.checkVersion(content);
console.log(`GaussianSplats3D holds ${new SplatBuffer(content).getSplatCount()} of 10 splats`);
NODE
venv/bin/python write.py | tee said
node view.mjs 2>/dev/null | tee -a said
node node_modules/@playcanvas/splat-transform/bin/cli.mjs -q -w -g cpu model.ksplat again.ply >/dev/null 2>&1
count=$(head -c 2000 again.ply | tr -d '\0' | grep -a '^element vertex' | cut -d' ' -f3)
echo "splat-transform reads $count of 10 splats" | tee -a said
if grep -q 'holds 0 of 10' said && [ "$count" = 10 ]; then
    echo "empty for its own viewer, as recorded"
else
    echo "CHANGED: the viewer's number of splats is another"
    exit 1
fi
