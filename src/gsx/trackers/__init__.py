"""Built-in trackers. Their packages are optional, and imported only if the tracker is chosen."""
