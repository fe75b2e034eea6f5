"""A run and its steps: the trainer, and what it asks of backbones, augmenters and regenerators."""
