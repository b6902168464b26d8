"""What becomes of vehicles that stand at the start: parked ones should stay, some of those on a lane should start."""

import torch
from torch import Tensor

STANDING = 0.5  # m/s at the start frame
MOVED = 2.0  # m from the start position


def moved(states: Tensor, valid: Tensor) -> Tensor:
    """Bool [B, N]: at some valid step [B, T+1, N] farther than MOVED from where it stood at step 0."""
    way = (states[..., :2] - states[:, :1, :, :2]).norm(dim=-1)
    return ((way > MOVED) & valid).any(1)


def standing_columns(batch: dict[str, Tensor], traffic: Tensor) -> dict[str, Tensor]:
    """parked_moved, starters and what they rest on, each [B], of traffic vehicles [B, N] recorded throughout.

    parked_moved: share of the parked_vehicles that move; standing: vehicles slower than STANDING at the start that are
    not parked; starters: those of them that move; starters_log: those that move in the log. Unlike safety metrics these
    look at the whole rollout. Without `parked` (rollouts read from files) they are unknown: NaN.
    """
    states, valid = batch["states"], batch["valid"]
    if "parked" not in batch:
        unknown = torch.full((len(states),), torch.nan, dtype=states.dtype)
        return dict.fromkeys(("parked_moved", "parked_vehicles", "starters", "starters_log", "standing"), unknown)
    counted = traffic & batch["logged_valid"].all(1)
    parked = counted & batch["parked"]
    standing = counted & ~batch["parked"] & (states[:, 0, :, 3] < STANDING)
    now, log = moved(states, valid), moved(batch["logged"], batch["logged_valid"])
    columns = {
        "parked_moved": (parked & now).sum(-1) / parked.sum(-1),
        "parked_vehicles": parked.sum(-1),
        "starters": (standing & now).sum(-1),
        "starters_log": (standing & log).sum(-1),
        "standing": standing.sum(-1),
    }
    return {name: value.to(states.dtype) for name, value in columns.items()}
