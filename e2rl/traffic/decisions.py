"""What e2 decides by rule, as numbers that a search may draw for each rollout
(docs/guide/evaluate.md).

The rule is the mode of every distribution of attacks: a try of which nothing is drawn
is e2 as it stands.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from e2rl.sim.world import World
from e2rl.traffic.responsibility import SAME_DIRECTION, leading, place_of

WHOM = (
    "any",
    "oncoming",
    "crossing",
    "beside",
    "leader",
)  # vehicles that may act on the ego
ANY, ONCOMING, CROSSING, BESIDE, LEADER = range(len(WHOM))
BY_RULE = -1.0  # a moment of meeting that nobody asks for


class Decisions(NamedTuple):
    """Decisions of one rollout, or of B rollouts, each [B]; as one tensor [B, D] in
    this order.

    strength: factor of eta, 0: nobody is controlled; whom: index into WHOM; patience:
    factor of how late adversaries give way; owes: 1, or below 0.5: they do not give
    way; wrong_way: s that an interception weighs more if it ends against the lanes;
    moment: s until the ego is met, BY_RULE: the cheapest; scatter: s of noise on what
    it costs each vehicle to meet the ego.
    """

    strength: Any = 1.0
    whom: Any = ANY
    patience: Any = 1.0
    owes: Any = 1.0
    wrong_way: Any = 0.0
    moment: Any = BY_RULE
    scatter: Any = 0.0


RULE = Decisions()


def eligible(world: World, whom: Tensor, lawful: bool) -> Tensor:
    """Bool [B, V]: vehicles that whom [B] lets act; lawful: leaders act only where they
    are named, since planners know how to follow."""
    vehicles = world.scene["route_log"].shape[1]
    along = (world.states[:, :vehicles, 2] - world.states[:, :1, 2]).cos()
    leads = leading(world, vehicles)
    beside = place_of(world, vehicles)[1] & ~leading(world, vehicles)
    oncoming = along < -SAME_DIRECTION
    kinds = torch.stack(
        [
            ~leads if lawful else leads | ~leads,
            oncoming,
            along.abs() <= SAME_DIRECTION,
            beside,
            leads,
        ]
    )
    return kinds[whom.long(), torch.arange(len(whom), device=whom.device)]
