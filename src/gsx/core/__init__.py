"""Core: scenes, rasterizer, training. It imports no plugin."""
