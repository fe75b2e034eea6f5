"""Files of splats and points: what each format holds, read and written."""
