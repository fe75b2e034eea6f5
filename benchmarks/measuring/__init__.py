"""Parts of the benchmarks. `adapter` holds all that they know of the rasterizer's inside."""
