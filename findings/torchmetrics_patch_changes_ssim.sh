#!/usr/bin/env bash
# Packages: torchmetrics 1.4.1 and 1.4.2 (PyPI), with torch 2.13.0 on the CPU; `structural_similarity_index_measure`.
# Input: two pictures of 40 x 32 px, noise and the same with more noise, in 64 bits; data_range=1.0 in all calls.
# Expected: a release that changes the last digit of a version leaves the figures of a metric as they are.
# Behaviour: up to 1.4.1 only windows that lie inside of a picture count; since 1.4.2 its borders are reflected, and windows
#   around all pixels count. Tables made before and after are not comparable. Without data_range both take the range of
#   the pictures at hand, another one for each pair.
# Output seen:
#   1.4.1: 0.8129, at half the contrast 0.8158, there without data_range 0.8129
#   1.4.2: 0.8159, at half the contrast 0.8188, there without data_range 0.8159
# Exit status 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    torch==2.13.0 numpy==2.2.6 lightning-utilities==0.15.2 packaging
for version in 1.4.1 1.4.2; do
    "$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-deps --target "$folder/$version" \
        "torchmetrics==$version"
done
cd "$folder"
cat > measure.py <<'PYTHON'
import torch
import torchmetrics
from torchmetrics.functional.image import structural_similarity_index_measure as similarity

generator = torch.Generator().manual_seed(0)
one = torch.rand(1, 3, 32, 40, generator=generator, dtype=torch.float64)
other = (one + 0.2 * torch.randn(one.shape, generator=generator, dtype=torch.float64)).clamp(0, 1)
half, lower = one / 2, other / 2
found = similarity(one, other, data_range=1.0), similarity(half, lower, data_range=1.0), similarity(half, lower)
print(
    "{}: {:.4f}, at half the contrast {:.4f}, there without data_range {:.4f}".format(
        torchmetrics.__version__, *map(float, found)
    )
)
PYTHON
printed=$(for version in 1.4.1 1.4.2; do PYTHONPATH="$folder/$version" venv/bin/python -W ignore measure.py; done)
echo "$printed"
[ "$printed" = "1.4.1: 0.8129, at half the contrast 0.8158, there without data_range 0.8129
1.4.2: 0.8159, at half the contrast 0.8188, there without data_range 0.8159" ]
