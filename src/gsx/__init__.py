"""gsx: experiments with 3D Gaussian Splatting and pseudo details. Importing this module does not import torch."""

__version__ = "0.1.0"
