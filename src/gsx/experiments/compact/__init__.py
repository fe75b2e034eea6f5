"""Smaller models that look the same: `gsx compact`."""
