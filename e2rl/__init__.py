"""Evaluation as Evolution: adversarial traffic from a diffusion prior as a curriculum
for driving policies.

The names below are those of e2rl.api, imported on first use; docs and an example stand
there.
"""

from importlib import import_module
from typing import Any

__all__ = [
    "find_failures",
    "load_prior",
    "load_scenes",
    "make_ego",
    "make_env",
    "make_gym_env",
    "make_sb3_env",
]
__all__ += ["make_traffic", "roll_out", "save_policy", "save_video", "score"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module("e2rl.api"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
