"""Held-out views measured."""
