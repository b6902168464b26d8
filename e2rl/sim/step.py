"""One step of B scenes, as a pure function of tensors: what an environment keeps, what it is told, what comes of it.

Everything of the others that a step asks for is looked up; only the ego's motion has to be taken step by step.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.scene.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.around import axes, look_around
from e2rl.sim.observation import CENTRE, EgoState, Lens, observe, probe
from e2rl.sim.reward import reward_terms, weighted_sum
from e2rl.sim.setting import Place, Setting, follow
from e2rl.sim.traffic import traffic_at


class Running(NamedTuple):
    """Of B scenes now: clock [B] int64; the ego's state [B, 4], last executed action [B, 2] and place; present [B]:
    still in the scene; been_on_road [B]: off the road counts from then on; start_s [B]: arc length at the start."""

    clock: Tensor
    ego: Tensor
    action: Tensor
    place: Place
    present: Tensor
    been_on_road: Tensor
    start_s: Tensor


class Stepped(NamedTuple):
    """What a step did: observation [B, D], reward [B], contact with a vehicle, with another agent, off_road, terminated
    and truncated (bool [B]), progress [B] since the start [m]."""

    observation: Tensor
    reward: Tensor
    contact: Tensor
    contact_vru: Tensor
    off_road: Tensor
    terminated: Tensor
    truncated: Tensor
    progress: Tensor


class Rules(NamedTuple):
    """horizon: steps of a scene; end_on_contact, end_off_road; weights [6]: of reward.TERMS; low, high [2]: bounds of
    the action."""

    horizon: int
    end_on_contact: bool
    end_off_road: bool
    weights: Tensor
    low: Tensor
    high: Tensor


def step(
    running: Running, action: Tensor, traffic: tuple[Tensor, Tensor], setting: Setting, rules: Rules, lens: Lens
) -> tuple[Running, Stepped]:
    """One step under action [B, 2]; traffic: everybody's states [B, T+1, N, 4] and presence [B, T+1, N]."""
    ego = dynamics.step(running.ego, torch.clamp(action, rules.low, rules.high))
    return advance(running, ego, running.present, traffic, setting, rules, lens)


def replay_step(
    running: Running,
    logged: tuple[Tensor, Tensor],
    traffic: tuple[Tensor, Tensor],
    setting: Setting,
    rules: Rules,
    lens: Lens,
) -> tuple[Running, Stepped]:
    """`step` of egos that follow their recording, states [B, T+1, N, 4] and presence [B, T+1, N] of it, and are gone
    with it."""
    row, clock = setting.row[:, 0], (running.clock + 1).clamp(max=rules.horizon)
    known = logged[1][row, clock, 0]
    ego = torch.where(known[:, None], logged[0][row, clock, 0], running.ego)
    return advance(running, ego, running.present & known, traffic, setting, rules, lens)


def advance(
    running: Running,
    ego: Tensor,
    present: Tensor,
    traffic: tuple[Tensor, Tensor],
    setting: Setting,
    rules: Rules,
    lens: Lens,
) -> tuple[Running, Stepped]:
    """What comes of a step that leads the egos to states ego [B, 4]; present [B]: those still there."""
    clock = (running.clock + 1).clamp(max=rules.horizon)
    action = dynamics.inverse(torch.stack([running.ego, ego], 1))[:, 0]
    place = follow(setting, ego[:, :2], running.place.s + running.ego[:, 3] * DT)
    turn = axes(ego)
    around = look_around(ego, turn, setting, *(value[:, 1:] for value in traffic_at(*traffic, clock)))
    beyond = probe(lens, setting, ego, turn)
    hit = (around.gap < 0) & around.present & present[:, None]
    contact, contact_vru = (hit & setting.vehicle).any(1), (hit & ~setting.vehicle).any(1)
    off = beyond[:, CENTRE] > 0
    off_road = off & running.been_on_road & present
    now = EgoState(ego, turn, action, place)
    observation, limit = observe(lens, setting, now, clock, rules.horizon, beyond, around)
    left = ~present | (place.s >= setting.end)
    touched, way = contact | contact_vru, place.s - running.place.s
    terms = reward_terms(way, touched, off_road, action, running.action, ego[:, 3], limit, place.d, DT)
    terminated = (touched & rules.end_on_contact) | (off_road & rules.end_off_road)
    after = Running(clock, ego, action, place, ~left, running.been_on_road | ~off, running.start_s)
    return after, Stepped(
        observation,
        weighted_sum(terms, rules.weights),
        contact,
        contact_vru,
        off_road,
        terminated,
        (clock >= rules.horizon) | left,
        place.s - running.start_s,
    )
