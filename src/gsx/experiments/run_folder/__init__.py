"""What a run folder holds, and the key that names a run by what it trains."""
