"""Diffusion models from `diffusers` as regenerators: extra `gsx[diffusion]`, imported when they are used."""
