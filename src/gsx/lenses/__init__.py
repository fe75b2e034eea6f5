"""Lenses through which cameras render: models of distortion, and the projection of Gaussians through them."""

from gsx.lenses.models import NATIVE, Distortion, lens_of

__all__ = ["NATIVE", "Distortion", "lens_of"]
