"""Rollouts of a run in the formats of other tools (docs/guide/export.md)."""
