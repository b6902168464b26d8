"""Commands beside train.py and evaluate.py: export, inspect, export of a policy."""
