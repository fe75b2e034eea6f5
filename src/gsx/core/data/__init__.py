"""Cameras, windows, views, scenes and their pictures."""
