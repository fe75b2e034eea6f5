"""Pages on one run and on many."""
