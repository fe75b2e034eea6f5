"""Gaussians: their parameters, harmonics and rotations, their neighbours."""
