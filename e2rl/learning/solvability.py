"""Solvability of synthesized traffic: some driver could have avoided the collision, and how."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.evasion.search import find_evasions
from e2rl.metrics.contact import first_contact
from e2rl.scene.scene import SceneSet
from e2rl.sim import dynamics
from e2rl.sim.env import SimSettings

DEPARTURE = 0.5  # m from where the ego drove at which an evasion has departed: 1 m/s^2 more or less lead so far in 1 s
LEAD = 10  # steps before its departure from which on an evasion acts
AFTER = 5  # steps after the contact until which it acts
LATE = 20  # steps before the contact at which an evasion is to begin: from its very start it would react to nothing


class Solved(NamedTuple):
    """Of synthesized traffic [S]: kept [S] bool: the ego was not hit, or there is an evasion; evasion [S, T, 2]: its
    actions from the start, 0 without one; span [S, 2] int64: the steps from .. up to which it acts, (0, 0) without
    one."""

    kept: Tensor
    evasion: Tensor
    span: Tensor


def unsearched(states: Tensor) -> Solved:
    """Everything is kept and no evasion known, of traffic with states [S, T+1, N, 4]."""
    rows, steps = states.shape[0], states.shape[1] - 1
    span = torch.zeros(rows, 2, dtype=torch.int64)
    return Solved(torch.ones(rows, dtype=torch.bool), torch.zeros(rows, steps, 2), span)


def solvable(traffic: Mapping[str, Tensor], scenes: SceneSet, sim: SimSettings) -> Solved:
    """A search with full knowledge of the others' motion (e2rl.evasion) where the ego was hit: for an evasion that
    begins LATE steps before the contact, and where none is found, for one from the start."""
    contact, solved = traffic["contact"].cpu(), unsearched(traffic["states"])
    hit = contact.nonzero()[:, 0]
    if len(hit):
        scene = scenes.batch(traffic["scene_index"].cpu()[hit])
        states, valid = (traffic[name].cpu()[hit] for name in ("states", "valid"))
        first = first_contact({"states": states, "valid": valid, **{key: scene[key] for key in ("size", "agent_type")}})
        late = (first["stop"] - LATE).clamp(min=0).masked_fill(~first["hit"], 0)
        result, begin = find_evasions(scene, states, valid, sim, moment=late), late
        again = (~result.found & (late > 0)).nonzero()[:, 0]
        if len(again):
            result[again] = find_evasions(scene[again], states[again], valid[again], sim)
            begin = begin.index_fill(0, again, 0)
        solved.kept[hit] = result.found
        shown = (result.found & first["hit"]).nonzero()[:, 0]
        actions = from_start(dynamics.inverse(states[shown, :, 0]), result.actions[shown], begin[shown])
        evasion = dynamics.rollout(states[shown, 0, 0], actions)
        solved.evasion[hit[shown]] = actions
        solved.span[hit[shown]] = acting(evasion, states[shown, 1:, 0], begin[shown], first["stop"][shown])
    return solved


def from_start(driven: Tensor, evasion: Tensor, begin: Tensor) -> Tensor:
    """Actions [S, T, 2]: those driven [S, T, 2] before step begin [S], then those of an evasion [S, T, 2] that begins
    there."""
    since = torch.arange(driven.shape[1]) - begin[:, None]
    late = evasion.gather(1, since.clamp(min=0)[..., None].expand_as(evasion))
    return torch.where((since >= 0)[..., None], late, driven)


def acting(evasion: Tensor, driven: Tensor, begin: Tensor, stop: Tensor) -> Tensor:
    """Steps [S, 2] from .. up to which evasions [S, T, 4] act instead of the drives driven [S, T, 4], both at steps
    1..T; begin [S]: the step from which on they differ; stop [S]: of the drives' contacts.

    From LEAD steps before the evasion has departed from the drive by DEPARTURE, until AFTER steps past the contact.
    """
    apart = (evasion[..., :2] - driven[..., :2]).norm(dim=-1) > DEPARTURE
    departed = torch.where(apart.any(1), apart.int().argmax(1) + 1, stop)
    first = (departed.minimum(stop) - LEAD).maximum(begin)
    return torch.stack([first, (stop + AFTER).clamp(max=evasion.shape[1])], 1)
