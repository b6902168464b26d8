"""Metrics: safety, realism and statistics as pure functions."""
