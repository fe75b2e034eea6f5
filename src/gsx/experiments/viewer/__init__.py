"""Looking around in a model, in a browser."""
