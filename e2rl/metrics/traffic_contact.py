"""Contacts within the simulated traffic (docs/reference/metrics.md)."""

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, Metric, columns, rate
from e2rl.metrics.contact import steps_until
from e2rl.metrics.geometry import pair_overlap
from e2rl.metrics.realism import MOVING


@columns(
    rate(
        "cfr_bg",
        "other simulated vehicles hit each other",
        tables="main traffic adversaries methods",
    ),
    Metric("bg_pairs", "pairs of other vehicles that hit each other"),
    rate(
        "touched",
        "moving vehicles that touch another simulated one",
        weight="moving_vehicles",
        tables="traffic",
    ),
    events=("moving_vehicles", "start_overlap_bg"),
)
def traffic_contact_columns(batch: Batch) -> Batch:
    """Pairs of `traffic` vehicles that overlap at a step 1..stop, and the fraction of
    moving vehicles among them.

    Pairs that overlap at step 0 already are counted apart and left out of the rest.
    """
    states = batch["states"]
    size = batch["size"]
    traffic = batch["traffic"]
    vehicles = traffic.any(0).nonzero()[:, 0]
    one, two = vehicles[torch.triu_indices(len(vehicles), len(vehicles), 1)]
    index = near_pairs(
        states,
        size,
        one=one,
        two=two,
        present=batch["valid"] & traffic[:, None],
    )
    row, step, pair = index
    overlap = torch.zeros(
        *states.shape[:2],
        len(one),
        dtype=torch.bool,
    )
    area = pair_overlap(
        states[row, step, one[pair]],
        size[row, one[pair]],
        second=states[row, step, two[pair]],
        second_size=size[row, two[pair]],
        possible=torch.ones_like(row, dtype=torch.bool),
    )
    overlap[index] = area > 0
    counted = steps_until(batch["stop"], states.shape[1])[..., None]
    hits = (overlap & counted).any(1) & ~overlap[:, 0]
    touches = torch.zeros_like(traffic, dtype=torch.int64)
    touches = touches.index_add(1, torch.cat([one, two]), hits.long().repeat(1, 2))
    return {
        "cfr_bg": hits.any(-1).to(states.dtype),
        "bg_pairs": hits.sum(-1),
        "start_overlap_bg": overlap[:, 0].any(-1),
        **touched_columns(batch, touches > 0),
    }


def near_pairs(
    states: Tensor,
    size: Tensor,
    *,
    one: Tensor,
    two: Tensor,
    present: Tensor,
) -> tuple[Tensor, ...]:
    """Indices (rollout, step, pair) where both agents of a pair are present and their
    bounding circles meet.

    Args:
        states: [B, T+1, N, 4].
        size: [B, N, 2].
        one, two: [P] int64, the agents of each pair.
        present: [B, T+1, N] bool.
    """
    x = states[..., 0]
    y = states[..., 1]
    radius = size.norm(dim=-1) / 2
    # In place: these tensors of all pairs at all steps bound the memory.
    square = (x[:, :, one] - x[:, :, two]).square_()
    square.add_((y[:, :, one] - y[:, :, two]).square_())
    near = square <= (radius[:, one] + radius[:, two]).square_()[:, None]
    return (present[:, :, one] & present[:, :, two] & near).nonzero(as_tuple=True)


def touched_columns(batch: Batch, touched: Tensor) -> Batch:
    """Fraction of the traffic that moves, in the rollout or its log, that is touched
    [B, N] by another vehicle."""
    simulated = (batch["states"][..., 3].abs() * batch["valid"]).amax(1)
    logged = (batch["logged"][..., 3].abs() * batch["logged_valid"]).amax(1)
    moving = batch["traffic"] & (torch.maximum(simulated, logged) > MOVING)
    number = moving.sum(-1)
    share = (touched & moving).sum(-1).to(simulated.dtype) / number  # 0 / 0 is NaN
    return {"touched": share, "moving_vehicles": number}
