"""Configuration of the example plugin."""
