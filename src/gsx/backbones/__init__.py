"""Representations that hand explicit Gaussians to the rasterizer."""
