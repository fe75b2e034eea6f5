"""Held-out views measured, and what to know beside the figures."""
