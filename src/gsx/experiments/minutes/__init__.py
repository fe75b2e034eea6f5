"""Runs planned by wall time: `minutes=N`."""
