"""Augmenters: what makes pseudo views."""
