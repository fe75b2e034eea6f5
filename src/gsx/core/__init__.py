"""The core: scenes, rasterizer, training, evaluation. It knows no plugin by name."""
