"""Scenes as folders for other programs: the photos that gsx trains on, cameras in their formats, and a manifest."""
