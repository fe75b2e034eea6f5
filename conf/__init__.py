"""Every default value of gsx, as Hydra configuration files."""
