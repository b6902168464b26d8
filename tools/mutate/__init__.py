"""Mutated copies of recorded logs: `python -m tools.mutate`."""
