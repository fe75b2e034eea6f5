"""Gaussians: parameters, spherical harmonics, rotations."""
