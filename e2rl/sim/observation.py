"""What a learned ego sees: an ego-centred vector of OBSERVATION_SIZE numbers of order one.

Blocks: ego (11), mission route ahead (12 x 5), lights (2 x 4), drivable probes (5 x 5), nearest agents (12 x 15).
"""

from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.scene.recording import LIGHT_UNKNOWN
from e2rl.sim.around import Around
from e2rl.sim.drivable import off_road
from e2rl.sim.setting import Place, Setting, look_along

LOOK_AHEAD = (2.0, 4.0, 7.0, 10.0, 14.0, 19.0, 25.0, 32.0, 40.0, 50.0, 62.0, 75.0)  # m along the mission
PROBE_X, PROBE_Y = (-3.0, 0.0, 5.0, 11.0, 20.0), (-5.0, -2.5, 0.0, 2.5, 5.0)  # m in the ego's frame
CENTRE = PROBE_X.index(0.0) * len(PROBE_Y) + PROBE_Y.index(0.0)  # the probe at the ego itself
NEAREST = 12  # agents
SPEED, FAR, NEAR = 15.0, 40.0, 10.0  # scales: m/s, m, m
OBSERVATION_SIZE = 11 + 5 * len(LOOK_AHEAD) + 8 + len(PROBE_X) * len(PROBE_Y) + 15 * NEAREST


class Lens(NamedTuple):
    """The numbers above as tensors: arc lengths ahead [13], the last 0; probes [25, 2]; scales of a route point [2] and
    of an agent's features [11, 1]; light colours [3]."""

    ahead: Tensor
    probes: Tensor
    point: Tensor
    agent: Tensor
    colours: Tensor


@cache
def lens(device: torch.device) -> Lens:
    """The Lens on a device, made once."""
    numbers = lambda *values: torch.tensor(values, device=device)  # noqa: E731
    return Lens(
        numbers(*LOOK_AHEAD, 0.0),
        torch.cartesian_prod(numbers(*PROBE_X), numbers(*PROBE_Y)),
        numbers(FAR, NEAR),
        numbers(FAR, NEAR, 1.0, 1.0, SPEED, SPEED, SPEED, 4.0, 2.5, 1.0, 1.0)[:, None],
        numbers(1, 2, 3),
    )


class EgoState(NamedTuple):
    """The egos now: state [B, 4], turn = `around.axes` of it, the last action executed [B, 2], its place."""

    state: Tensor
    turn: Tensor
    action: Tensor
    place: Place


def observe(
    lens: Lens, setting: Setting, ego: EgoState, step: Tensor, horizon: int, beyond: Tensor, around: Around
) -> tuple[Tensor, Tensor]:
    """Observation [B, OBSERVATION_SIZE], and the speed limit at the ego [B].

    step [B] of horizon; beyond [B, 25]: `probe` there; around: the others.
    """
    route, limit = route_features(lens, setting, ego)
    parts = [
        ego_features(setting, ego, limit, step / horizon),
        route,
        light_features(lens, setting, step, ego.place.s),
        (beyond / 4).clamp(-1, 1),
        agent_features(lens, setting, ego, around),
    ]
    return torch.cat(parts, -1), limit


def probe(lens: Lens, setting: Setting, state: Tensor, turn: Tensor) -> Tensor:
    """[B, 25]: drivable field at a grid of points around and ahead of an ego at state [B, 4]."""
    points = torch.baddbmm(state[:, None, :2], lens.probes.expand(len(state), -1, -1), turn)
    return off_road(points, setting.field, setting.origin)


def ego_features(setting: Setting, ego: EgoState, limit: Tensor, time: Tensor) -> Tensor:
    """[B, 11]: speed, last action, lane pose, speed limit, way left before the map ends, size, share of time gone."""
    state, action, place, size = ego.state, ego.action, ego.place, setting.size
    turned = state[:, 2] - place.heading
    return torch.stack(
        [
            state[:, 3] / SPEED,
            action[:, 0] / 4,
            action[:, 1],
            (place.d / 3).clamp(-2, 2),
            turned.sin(),
            turned.cos(),
            limit / SPEED,
            ((setting.end - place.s) / 100).clamp(0, 1),
            size[:, 0] / 5,
            size[:, 1] / 2,
            time,
        ],
        -1,
    )


def route_features(lens: Lens, setting: Setting, ego: EgoState) -> tuple[Tensor, Tensor]:
    """[B, 12 * 5]: mission points ahead in the ego's frame, relative heading, curvature, speed limit; and the limit at
    the ego [B]."""
    xy, heading, curvature, limit = look_along(setting, ego.place.s[:, None] + lens.ahead)
    local = (xy - ego.state[:, None, :2]).bmm(ego.turn.transpose(1, 2)) / lens.point
    turned = (heading - ego.state[:, 2:3]).sin()
    features = torch.cat([local, torch.stack([turned, (10 * curvature).clamp(-2, 2), limit / SPEED], -1)], -1)
    return features[:, :-1].clamp(-5, 5).flatten(1), limit[:, -1]


def light_features(lens: Lens, setting: Setting, step: Tensor, s: Tensor) -> Tensor:
    """[B, 2 * 4]: the mission's lights red, yellow, green (one-hot while ahead) and how near (1 at hand, 0 far)."""
    if not setting.colours.shape[2]:
        return s.new_zeros(len(s), 8)
    recorded = setting.colours.shape[1]  # planners look beyond it: the last state stays
    now = setting.colours.flatten(0, 1).index_select(0, setting.row[:, 0] * recorded + step.clamp(max=recorded - 1))
    state = now.gather(1, setting.light.clamp(min=0)).masked_fill(setting.light < 0, LIGHT_UNKNOWN)
    ahead = setting.light_s - s[:, None]
    seen = (setting.light >= 0) & (ahead > -2)
    colours = state[..., None] == lens.colours
    near = (-ahead.clamp(min=0) / 30).exp()
    return (torch.cat([colours.to(s.dtype), near[..., None]], -1) * seen[..., None]).flatten(1)


def agent_features(lens: Lens, setting: Setting, ego: EgoState, around: Around) -> Tensor:
    """[B, 12 * 15]: nearest agents; present, relative pose and velocity, speed, acceleration, size, type, gap and
    closest approach at constant velocities (method_and_baselines.md 8.5, fixed form). Absent agents are zeros."""
    apart = around.local.square().sum(1).masked_fill(~around.present, torch.inf)
    count = min(NEAREST, apart.shape[1])
    index = apart.topk(count, dim=1, largest=False).indices
    everybody = torch.cat(
        [
            around.local,
            around.direction,
            setting.half,
            torch.stack([around.gap, around.speed, around.accel, setting.vehicle, around.present], 1),
        ],
        1,
    )
    near = everybody.gather(2, index[:, None].expand(-1, everybody.shape[1], -1))
    local, direction, half, gap, speed, accel, vehicle, present = near.split((2, 2, 2, 1, 1, 1, 1, 1), 1)
    velocity = speed * direction - torch.nn.functional.pad(ego.state[:, 3:, None], (0, 0, 0, 1))
    time = (-(local * velocity).sum(1, True) / (velocity.square().sum(1, True) + 1e-3)).clamp(0, 8)
    miss = (local + velocity * time).norm(dim=1, keepdim=True)
    scaled = torch.cat([local, direction, velocity, speed, accel, half, vehicle], 1) / lens.agent
    decay = torch.cat([-time / 2, -miss / 5], 1).exp()
    features = torch.cat([present, scaled.clamp(-5, 5), (gap / NEAR).clamp(-1, 2), decay], 1) * present
    features = features.transpose(1, 2).flatten(1)
    return torch.nn.functional.pad(features, (0, 15 * (NEAREST - count)))
