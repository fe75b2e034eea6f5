"""Pictures and splats of any program, measured by one protocol."""
