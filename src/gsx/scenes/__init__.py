"""Loaders: one per format, a `Scene` out of each."""
