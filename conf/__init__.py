"""The configuration of train.py and evaluate.py; a package, so that Hydra finds it
in the installed one."""
