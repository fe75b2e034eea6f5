"""Regenerators: what redraws pictures."""
