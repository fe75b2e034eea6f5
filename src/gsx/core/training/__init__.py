"""Training: the trainer, the run, and the interfaces of backbones, modules, augmenters and regenerators."""
