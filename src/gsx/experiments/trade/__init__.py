"""What each setting of the rasterizer costs, and what it changes."""
