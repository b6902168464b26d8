"""The attack with a budget: tries of a scene that differ, spent where they find most
(docs/guide/evaluate.md)."""
