"""Files of a run: read, saved, found again."""
