"""Scenes: recordings, lane graphs, routes and their sources."""
