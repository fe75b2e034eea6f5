"""How pixels are blended fast, and how compiled code is kept."""
