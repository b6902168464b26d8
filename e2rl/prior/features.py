"""What the denoiser knows of each vehicle (nodes) and of each pair (edges), in the vehicle's own terms."""

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.routed import RoutedScene
from e2rl.scene.recording import DT, LIGHT_GREEN, LIGHT_RED, LIGHT_YELLOW
from e2rl.scene.route import SPACING, interpolate
from e2rl.scene.smoothing import PAST
from e2rl.sim.leaders import FREE, idm_acceleration, leaders

CURVATURE_AT = (0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0)  # m ahead
TURN_AT = (10.0, 20.0, 40.0, 60.0, 80.0)
LEADER_AT = (0.0, 1.5, 3.0)  # s ahead, the others at constant velocity
COMFORT_LATERAL, COMFORT_BRAKE = 2.5, 1.2  # m/s^2
NODE, EDGE = 51 + PAST + 4, 15
SIDED_NODE = (2, 3, 4, *range(9, 22), *range(51 + PAST, NODE))  # features that change sign under a mirror image
SIDED_EDGE = (1, 3, 5, 13)


def _at(values: Tensor, s: Tensor) -> Tensor:
    """values [B, V, P] at the vertex of arc length s [B, V]."""
    index = (s / SPACING).round().long().clamp(0, values.shape[-1] - 1)
    return values.gather(-1, index[..., None])[..., 0]


def _lights(routed: RoutedScene, state: LaneState, step: Tensor) -> list[Tensor]:
    """Per light of the route: nearness, red, yellow, green, braking needed to stop at it (12 s ahead at most)."""
    out = []
    states = routed.light_state
    for k in range(routed.light.shape[-1]):
        ahead = routed.light_s[..., k] - state.s
        seen = (routed.light[..., k] >= 0) & (ahead > -1.0) & (ahead < 120.0)
        if states.shape[-1]:
            now = states[torch.arange(len(states), device=step.device), step.clamp(max=states.shape[1] - 1)]
            colour = now.gather(1, routed.light[..., k].clamp(min=0))
        else:
            colour = torch.zeros_like(routed.light[..., k])
        need = (state.v**2 / (2 * ahead.clamp(min=1.0))).clamp(max=8.0)
        out.append(torch.where(seen, 1 - ahead / 120.0, 0.0))
        out += [(seen & (colour == c)).float() for c in (LIGHT_RED, LIGHT_YELLOW, LIGHT_GREEN)]
        out.append(torch.where(seen & (colour != LIGHT_GREEN), need / 4, 0.0))
    return out


def past_features(past: Tensor, v: Tensor, estimated: Tensor) -> list[Tensor]:
    """PAST + 4 features [B, V] of what was seen before the start: the speed in each 0.1 s against the present one, the
    way aside and the turn 0.5 s and 1 s ago. Only an estimate needs them: 0 where states are exact."""
    ahead = torch.cat([torch.zeros_like(past[..., :1, 0]), past[..., 0]], -1)
    change = ((-ahead.diff(dim=-1) / DT - v[..., None]) / 2).clamp(-2, 2)
    at = past[..., PAST // 2 - 1 :: PAST // 2, :]
    features = torch.cat([change, at[..., 1].clamp(-5, 5), 5 * at[..., 2].clamp(-1, 1)], -1)
    return (features * estimated[:, None, None]).unbind(-1)


def curve_speed(state: LaneState, points: Tensor, lateral: float, brake: float) -> Tensor:
    """Highest speed now [B, V] from which all curves within 80 m can be met at `lateral` m/s^2, braking at `brake`."""
    ahead = torch.arange(0.0, 80.0, 4.0, device=state.s.device)
    curvature = interpolate(points, state.s[..., None] + ahead)[2].abs()
    return torch.sqrt(lateral / curvature.clamp(min=1e-4) + 2 * brake * ahead).min(-1).values


def node_features(
    routed: RoutedScene, state: LaneState, agents: Tensor, present: Tensor, step: Tensor, estimated: Tensor
) -> Tensor:
    """[B, V, NODE] from lane states [B, V], agents' states [B, N, 4], present [B, N] and the simulated step [B].

    estimated [B] bool: the states are a causal observer's estimates (a recording's start), not exact ones (simulated
    later on); trust in the present speed and acceleration depends on it.
    """
    size, vehicles = routed.size, state.s.shape[1]
    v, width, length = state.v, size[:, :vehicles, 1], size[:, :vehicles, 0]
    limit = _at(routed.limit, state.s)
    known = limit > 0
    offsets = torch.tensor(CURVATURE_AT + TURN_AT, device=v.device)
    _, heading, curvature = interpolate(routed.points, state.s[..., None] + torch.cat([offsets, offsets[:1] * 0]))
    count = len(CURVATURE_AT)
    turn = (heading[..., count:-1] - heading[..., -1:] + torch.pi) % (2 * torch.pi) - torch.pi
    curve = curve_speed(state, routed.points, COMFORT_LATERAL, COMFORT_BRAKE)
    rest = torch.where(routed.open, routed.length - state.s, 200.0).clamp(-10.0, 200.0)
    moved = torch.stack([torch.cos(agents[..., 2]), torch.sin(agents[..., 2])], -1) * agents[..., 3:]
    future = torch.cat([torch.cat([agents[..., :2] + t * moved, agents[..., 2:]], -1) for t in LEADER_AT], 1)
    lead, first = [], None
    for k in range(len(LEADER_AT)):
        there = future[:, k * agents.shape[1] : (k + 1) * agents.shape[1]]
        gap, speed, _ = leaders(state.s, width, length, routed.points, there, size, present)
        first = (gap, speed) if first is None else first
        lead += [torch.exp(-gap.clamp(min=0) / 20.0), torch.where(gap < FREE, (v - speed) / 5.0, 0.0)]
    target = torch.where(known, limit, 15.0)
    idm = idm_acceleration(v, target, *first, 1.0, 2.0, 1.5, 2.0).clamp(-6.0, 2.0)
    features = [
        v / 10,
        state.a / 2,
        state.d,
        state.d1 * 5,
        state.d2 * 20,
        (v < 0.5).float(),
        known.float(),
        torch.where(known, (limit - v) / 10, 0.0),
        torch.where(known, limit / 15, 0.0),
        *(curvature[..., :count] * 15).clamp(-3, 3).unbind(-1),
        *turn.unbind(-1),
        state.kappa * v,
        ((curve - v) / 5).clamp(-2, 2),
        torch.exp(-rest.clamp(min=0) / 30),
        (rest < 200).float(),
        *lead,
        idm / 2,
        *_lights(routed, state, step),
        length / 5,
        width / 2,
        routed.parked.float(),
        routed.has_lane.float(),
        (first[0] < FREE).float(),
        (v * v / (2 * first[0].clamp(min=1.0))).clamp(max=8) / 4,
        (v / 10) ** 2,
        torch.sqrt(v.clamp(min=0) + 1e-3) / 3,
        estimated[:, None].float().expand_as(v),
        *past_features(routed.past, v, estimated),
    ]
    return torch.stack(features, -1)


def edge_features(routed: RoutedScene, state: LaneState) -> Tensor:
    """[B, V, V, EDGE]: j in i's frame, and where their routes meet."""
    x, y, heading, v = state.x, state.y, state.heading, state.v
    cos, sin = torch.cos(heading)[..., None], torch.sin(heading)[..., None]
    dx, dy = x[:, None, :] - x[..., None], y[:, None, :] - y[..., None]
    along, aside = cos * dx + sin * dy, cos * dy - sin * dx
    turn = heading[:, None, :] - heading[..., None]
    vx, vy = v[:, None, :] * torch.cos(turn) - v[..., None], v[:, None, :] * torch.sin(turn)
    distance = torch.sqrt(dx**2 + dy**2 + 0.01)
    closing = -(along * vx + aside * vy) / distance
    mine = routed.conflict_s - state.s[..., None]
    theirs = mine.transpose(1, 2)
    meet = routed.conflict & (mine > -3) & (theirs > -3)
    arrival = mine / v[..., None].clamp(min=1.0) - theirs / v[:, None, :].clamp(min=1.0)
    zero = torch.zeros_like(mine)
    features = [
        along / 30,
        aside / 10,
        torch.cos(turn),
        torch.sin(turn),
        vx / 10,
        vy / 10,
        torch.exp(-distance / 20),
        closing / 10,
        torch.exp(-distance / 5),
        meet.float(),
        torch.where(meet, torch.exp(-mine.clamp(min=0) / 30), zero),
        torch.where(meet, torch.exp(-theirs.clamp(min=0) / 30), zero),
        torch.where(meet, torch.cos(routed.crossing), zero),
        torch.where(meet, torch.sin(routed.crossing), zero),
        torch.where(meet, torch.tanh(arrival / 3), zero),
    ]
    return torch.stack(features, -1)
