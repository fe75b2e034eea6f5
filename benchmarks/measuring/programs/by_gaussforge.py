"""python by_gaussforge.py FROM TO [VERSION]: gaussforge converts by suffix."""

import sys
from pathlib import Path

import gaussforge

FORMATS = ("compressed.ply", "ply", "spz", "sog", "splat", "ksplat", "glb")
source, target = map(Path, sys.argv[1:3])
kinds = [next(kind for kind in FORMATS if path.name.endswith(f".{kind}")) for path in (source, target)]
options = {"spz_version": int(sys.argv[3])} if len(sys.argv) > 3 else {}
result = gaussforge.GaussForge().convert(source.read_bytes(), *kinds, **options)
if "data" not in result:
    sys.exit(str(result.get("error")))
target.write_bytes(result["data"])
