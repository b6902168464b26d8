"""The commands: `e2rl evaluate`, `train`, `report`, `export`, ... (cli.py)."""
