#!/usr/bin/env bash
# Package: @playcanvas/splat-transform 3.7.0 (npm), SOG, version 2, written and read by itself.
# Expected: opacities and positions are rounded to the nearest step (1/255; 1/65535 of an axis), so that errors
#   are at most half a step, of both signs, and 0 on average.
# Behaviour: they are cut off. Every opacity comes back smaller, half a step on average and up to a whole one; every
#   position comes back at or below its place on the logarithmic axis, by up to a whole step.
# Output seen:
#   opacity, steps of 1/255: mean -0.50, from -1.00 to 0.00
#   position, steps of its axis: mean -0.49, from -1.00 to 0.00
#   cut off, as recorded
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm init -y >/dev/null
npm install --silent --no-audit --no-fund --ignore-scripts @playcanvas/splat-transform@3.7.0 >/dev/null 2>&1
cat > splats.py <<'PYTHON'
import math, struct, sys

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
         "rot_0", "rot_1", "rot_2", "rot_3"]
COUNT = 2000


def share(i):
    return (i * 0.6180339887498949) % 1


def model():
    """(x, opacity) of splats: x ascends, from 1 to 50; opacities from 0.02 to 0.98."""
    return [(1 + 49 * (i + 0.8 * share(7 * i)) / COUNT, 0.02 + 0.96 * share(i)) for i in range(COUNT)]


def write(path):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex %d\n" % COUNT
    head += "".join("property float %s\n" % name for name in NAMES) + "end_header\n"
    rows = [(x, 1 + share(3 * i), 1 + share(5 * i), 0, 0, 0, math.log(o / (1 - o)), -3, -3, -3, 1, 0, 0, 0)
            for i, (x, o) in enumerate(model())]
    with open(path, "wb") as file:
        file.write(head.encode() + b"".join(struct.pack("<14f", *row) for row in rows))


def read(path):
    content = open(path, "rb").read()
    head, body = content.split(b"end_header\n", 1)
    names = [line.split()[2].decode() for line in head.splitlines() if line.startswith(b"property")]
    rows = [dict(zip(names, row)) for row in struct.iter_unpack("<%df" % len(names), body)]
    return sorted((row["x"], 1 / (1 + math.exp(-row["opacity"]))) for row in rows)


def report(name, errors):
    mean = sum(errors) / len(errors)
    print("%s: mean %.2f, from %.2f to %.2f" % (name, mean, min(errors), round(max(errors), 2) + 0.0))
    return mean


if sys.argv[1] == "write":
    write(sys.argv[2])
else:
    made, back = model(), read(sys.argv[2])
    assert len(back) == COUNT
    step = (math.log1p(made[-1][0]) - math.log1p(made[0][0])) / 65535
    opacity = report("opacity, steps of 1/255", [255 * (b[1] - a[1]) for a, b in zip(made, back)])
    steps = [(math.log1p(b[0]) - math.log1p(a[0])) / step for a, b in zip(made, back)]
    position = report("position, steps of its axis", steps)
    cut = abs(opacity + 0.5) < 0.1 and abs(position + 0.5) < 0.1
    print("cut off, as recorded" if cut else "CHANGED: no longer cut off")
    sys.exit(not cut)
PYTHON
program=node_modules/@playcanvas/splat-transform/bin/cli.mjs
python3 splats.py write model.ply
node "$program" -q -w -g cpu model.ply model.sog >/dev/null 2>&1
node "$program" -q -w -g cpu model.sog again.ply >/dev/null 2>&1
python3 splats.py compare again.ply
