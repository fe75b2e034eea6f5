"""Content of run folders, and the key that names a run by what it trains."""
