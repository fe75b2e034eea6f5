"""Models of blocks of a large scene, as one."""
