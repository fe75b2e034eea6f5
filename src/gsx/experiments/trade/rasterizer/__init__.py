"""What each knob of the rasterizer costs."""
