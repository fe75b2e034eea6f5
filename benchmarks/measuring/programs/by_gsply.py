"""python by_gsply.py FROM TO [VERSION]: gsply converts by suffix."""

import sys

import gsply

source, target = sys.argv[1:3]
data = gsply.read_spz(source) if source.endswith(".spz") else gsply.plyread(source)
if target.endswith(".spz"):
    gsply.write_spz(target, data, version=int(sys.argv[3]))
else:
    gsply.plywrite(target, data, compressed=target.endswith(".compressed.ply"))
