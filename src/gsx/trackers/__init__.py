"""Trackers that come with gsx. Their packages are optional, and imported only when a tracker is chosen."""
