#!/usr/bin/env bash
# Package: @playcanvas/splat-transform 2.7.1 and 3.7.0 (npm), .spz written by one version and read by the other; and
#   the extension SPZ_ADOBE_coordinate_system of SPZ 4, by which a file states its axes.
# Expected: a file of one version comes back from the other as it was, and a file that states its axes is
#   read in them.
# Behaviour: 2.7.1 stores the axes that the format specifies (x right, y up, z back), 3.7.0 those of the PLY, and
#   nothing in the files says which. Each reads its own files, and turns the other's by 180 degrees about x. 3.7.0
#   passes over the extension: a file that states x right, y up, z back comes back as if it stated nothing.
# Output seen:
#   2.7.1 -> 2.7.1: (1, 2, 3)
#   2.7.1 -> 3.7.0: (1, -2, -3)
#   3.7.0 -> 2.7.1: (1, -2, -3)
#   3.7.0 -> 3.7.0: (1, 2, 3)
#   2.7.1, stating its axes -> 3.7.0: (1, -2, -3)
#   turned, as recorded
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
for version in 2.7.1 3.7.0; do
  mkdir "$version"
  (cd "$version" && npm init -y >/dev/null && npm install --silent --no-audit --no-fund --ignore-scripts \
    "@playcanvas/splat-transform@$version" >/dev/null 2>&1)
done
cat > splat.py <<'PYTHON'
import struct, sys

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
         "rot_0", "rot_1", "rot_2", "rot_3"]


def write(path):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    head += "".join("property float %s\n" % name for name in NAMES) + "end_header\n"
    with open(path, "wb") as file:
        file.write(head.encode() + struct.pack("<14f", 1, 2, 3, 0, 0, 0, 1, -3, -3, -3, 1, 0, 0, 0))


def state_axes(path, to):
    """The same file of SPZ 4 with an extension of 12 bytes before the table of its streams: axes number 4, RUB."""
    content = bytearray(open(path, "rb").read())
    content[14] |= 2
    content[16:20] = struct.pack("<I", 32 + 12)
    content[32:32] = struct.pack("<III", 0xADBE0003, 4, 4)
    open(to, "wb").write(content)


def position(path):
    head, body = open(path, "rb").read().split(b"end_header\n", 1)
    names = [line.split()[2].decode() for line in head.splitlines() if line.startswith(b"property")]
    row = dict(zip(names, struct.unpack_from("<%df" % len(names), body)))
    return tuple(round(row[axis]) for axis in "xyz")


if sys.argv[1] == "write":
    write(sys.argv[2])
elif sys.argv[1] == "state":
    state_axes(*sys.argv[2:])
else:
    seen = [position(path) for path in sys.argv[2:]]
    names = ["2.7.1 -> 2.7.1", "2.7.1 -> 3.7.0", "3.7.0 -> 2.7.1", "3.7.0 -> 3.7.0", "2.7.1, stating its axes -> 3.7.0"]
    for name, place in zip(names, seen, strict=True):
        print("%s: (%d, %d, %d)" % (name, *place))
    turned = seen == [(1, 2, 3), (1, -2, -3), (1, -2, -3), (1, 2, 3), (1, -2, -3)]
    print("turned, as recorded" if turned else "CHANGED: other axes")
    sys.exit(not turned)
PYTHON
convert() { node "$1/node_modules/@playcanvas/splat-transform/bin/cli.mjs" "$2" -w "$3" >/dev/null 2>&1; }
python3 splat.py write model.ply
for writer in 2.7.1 3.7.0; do
  convert "$writer" model.ply "of_$writer.spz"
  for reader in 2.7.1 3.7.0; do convert "$reader" "of_$writer.spz" "${writer}_$reader.ply"; done
done
python3 splat.py state of_2.7.1.spz stating.spz
convert 3.7.0 stating.spz stating.ply
python3 splat.py compare 2.7.1_2.7.1.ply 2.7.1_3.7.0.ply 3.7.0_2.7.1.ply 3.7.0_3.7.0.ply stating.ply
