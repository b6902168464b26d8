"""Vehicles that stand at the start: parked ones should stay, some of those on a lane should start."""

from torch import Tensor

STANDING = 0.5  # m/s at the start frame
MOVED = 2.0  # m from the start position


def moved(states: Tensor, valid: Tensor) -> Tensor:
    """Bool [B, N]: at some valid step [B, T+1, N] farther than MOVED from its position at step 0."""
    distance = (states[..., :2] - states[:, :1, :, :2]).norm(dim=-1)
    return ((distance > MOVED) & valid).any(1)


def standing_columns(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """parked_moved, starters and what they rest on, each [B], of `traffic` vehicles recorded throughout.

    parked_moved: share of the parked_vehicles that move. starters: vehicles slower than STANDING at the start, not
    parked, that move; starters_log: those that move in the log. Unlike safety metrics these look at the whole rollout.
    Nothing is known without `parked`, which rollouts read from files lack.
    """
    if "parked" not in batch:
        return {}
    states = batch["states"]
    counted = batch["traffic"] & batch["logged_valid"].all(1)
    parked = counted & batch["parked"]
    standing = counted & ~batch["parked"] & (states[:, 0, :, 3] < STANDING)
    now, log = moved(states, batch["valid"]), moved(batch["logged"], batch["logged_valid"])
    columns = {
        "parked_moved": (parked & now).sum(-1) / parked.sum(-1),
        "parked_vehicles": parked.sum(-1),
        "starters": (standing & now).sum(-1),
        "starters_log": (standing & log).sum(-1),
    }
    return {name: value.to(states.dtype) for name, value in columns.items()}
