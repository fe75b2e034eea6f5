"""Built-in scene loaders: one per format, one `Scene` out."""
