"""Compositors and their compiled code, the cache between runs, threads and processes."""
