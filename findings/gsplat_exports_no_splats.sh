#!/usr/bin/env bash
# Package: gsplat 1.5.3 (PyPI), on the CPU; `export_splats`, which leaves out splats that hold NaN or infinity.
# Input: five splats. One is quite opaque: torch.logit makes infinity of its opacity 1. Or one position is NaN.
# Expected: the one splat is left out, and the other four are in the file.
# Behaviour: for a position, a scale, a rotation or a colour it is so. The test of the opacities reduces over all splats
#   and not over the values of one: a single one that is not finite drops the whole model. The PLY is well formed,
#   has 0 vertices, and nothing says so.
# Output seen:
#   all finite: 5 of 5 splats
#   one position NaN: 4 of 5 splats
#   one opacity 1: 0 of 5 splats
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check gsplat==1.5.3 torch==2.13.0 numpy==2.2.6
cd "$folder"
venv/bin/python -W ignore - <<'PYTHON'
import sys

import torch
from gsplat.exporter import export_splats


def exported(position=0.0, opacity=0.5):
    """The number of vertices in the PLY of five splats, the third of which has this x and this opacity."""
    means = torch.arange(15.0).reshape(5, 3)
    means[2, 0] = position
    opacities = torch.full((5,), 0.5)
    opacities[2] = opacity
    content = export_splats(
        means=means,
        scales=torch.full((5, 3), -3.0),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(5, 1),
        opacities=torch.logit(opacities),
        sh0=torch.zeros(5, 1, 3),
        shN=torch.zeros(5, 0, 3),
    )
    head, _, body = content.partition(b"end_header\n")
    (count,) = [int(line.split()[2]) for line in head.splitlines() if line.startswith(b"element vertex")]
    assert len(body) == count * 4 * (3 + 3 + 1 + 3 + 4)
    return count


found = [exported(), exported(position=float("nan")), exported(opacity=1.0)]
for name, count in zip(("all finite", "one position NaN", "one opacity 1"), found):
    print(f"{name}: {count} of 5 splats")
sys.exit(0 if found == [5, 4, 0] else 1)
PYTHON
