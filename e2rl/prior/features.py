"""Inputs of the denoiser: features of each vehicle (nodes) and of each pair of vehicles
(edges), in vehicle frames."""

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.routes import ROUTED, RoutedScene
from e2rl.run.fused import fused
from e2rl.scenes.recording import DT, LIGHT_GREEN, LIGHT_RED, LIGHT_YELLOW
from e2rl.scenes.route import SPACING, interpolate
from e2rl.scenes.smoothing import PAST
from e2rl.sim.dynamics import constant_velocity, wrap
from e2rl.sim.leaders import FREE_GAP, IDMParameters, Leaders, idm_acceleration, leaders
from e2rl.sim.mission import light_state_at

CURVATURE_AT = (0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0)  # m ahead
TURN_AT = (10.0, 20.0, 40.0, 60.0, 80.0)  # m ahead
LEADER_AT = (0.0, 1.5, 3.0)  # s ahead, the others at constant velocity
COMFORT_LATERAL = 2.5  # m/s^2
COMFORT_BRAKE = 1.2  # m/s^2
DRIVER = IDMParameters(
    headway=1.0,
    standstill_gap=2.0,
    acceleration=1.5,
    braking=2.0,
)
NODE = 51 + PAST + 4
EDGE = 15
# Features that change sign under a mirror image.
SIDED_NODE = (2, 3, 4, *range(9, 22), *range(51 + PAST, NODE))
SIDED_EDGE = (1, 3, 5, 13)


@fused(ROUTED, "B V", ("B V 3", "B V 3", "B V 3:int64"), "B:int64", "B:bool")
def node_features(
    routed: RoutedScene,
    state: LaneState,
    followed: Leaders,
    step: Tensor,
    estimated: Tensor,
) -> Tensor:
    """Features [B, V, NODE] of each vehicle.

    Args:
        routed: the scenes with their routes.
        state: fields [B, V], the vehicles on these.
        followed: the `leaders_ahead`.
        step: [B], simulated steps.
        estimated: [B] bool: the states are a causal observer's estimates (a recording's
            start) instead of exact ones (simulated later on); how far the present speed
            and acceleration can be trusted depends on it.
    """
    v = state.v.clamp(min=0)  # who reverses is to halt: it is seen as if it stood
    length, width = routed.size[:, : v.shape[1]].unbind(-1)
    at = (state.s / SPACING).round().long().clamp(0, routed.limit.shape[-1] - 1)
    limit = routed.limit.gather(-1, at[..., None])[..., 0]
    limited = limit > 0
    near = torch.exp(-followed.gap.clamp(min=0) / 20.0)
    closing = (v[..., None] - followed.speed) / 5.0
    closing = torch.where(followed.gap < FREE_GAP, closing, 0.0)
    gap = followed.gap[..., 0]
    idm = idm_acceleration(
        v,
        torch.where(limited, limit, 15.0).clamp(min=1.0),
        gap=gap,
        leader_speed=followed.speed[..., 0],
        driver=DRIVER,
        improved=False,
    )
    features = [
        v / 10,
        state.a / 2,
        state.d,
        state.d1 * 5,
        state.d2 * 20,
        (v < 0.5).float(),
        limited.float(),
        torch.where(limited, (limit - v) / 10, 0.0),
        torch.where(limited, limit / 15, 0.0),
        *_route_features(routed, state),
        *torch.stack([near, closing], -1).flatten(2).unbind(-1),
        idm.clamp(-6.0, 2.0) / 2,
        *_light_features(routed, state, step),
        length / 5,
        width / 2,
        routed.parked.float(),
        routed.has_lane.float(),
        (gap < FREE_GAP).float(),
        (v * v / (2 * gap.clamp(min=1.0))).clamp(max=8) / 4,
        (v / 10) ** 2,
        torch.sqrt(v.clamp(min=0) + 1e-3) / 3,
        estimated[:, None].float().expand_as(v),
        *_past_features(routed.past, state.v, estimated),
    ]
    return torch.stack(features, -1)


def _route_features(routed: RoutedScene, state: LaneState) -> list[Tensor]:
    """Curvatures and turns of the route ahead, lateral acceleration, speed to spare for
    curves, rest of the route."""
    offsets = torch.tensor((*CURVATURE_AT, *TURN_AT, 0.0), device=state.s.device)
    _, heading, curvature = interpolate(routed.points, state.s[..., None] + offsets)
    count = len(CURVATURE_AT)
    turn = wrap(heading[..., count:-1] - heading[..., -1:])
    curve = curve_speed(
        state,
        routed.points,
        lateral=COMFORT_LATERAL,
        brake=COMFORT_BRAKE,
    )
    rest = torch.where(routed.open, routed.length - state.s, 200.0).clamp(-10.0, 200.0)
    return [
        *(curvature[..., :count] * 15).clamp(-3, 3).unbind(-1),
        *turn.unbind(-1),
        state.kappa * state.v,
        ((curve - state.v) / 5).clamp(-2, 2),
        torch.exp(-rest.clamp(min=0) / 30),
        (rest < 200).float(),
    ]


def curve_speed(
    state: LaneState,
    points: Tensor,
    *,
    lateral: float,
    brake: float,
) -> Tensor:
    """Highest speed [B, V] m/s from which all curves within 80 m can be met.

    Args:
        state: fields [B, V].
        points: [B, V, P, 2] m, routes.
        lateral: m/s^2, lateral acceleration in the curves.
        brake: m/s^2, braking on the way to them.
    """
    ahead = torch.arange(0.0, 80.0, 4.0, device=state.s.device)
    curvature = interpolate(points, state.s[..., None] + ahead)[2].abs()
    squared = lateral / curvature.clamp(min=1e-4) + 2 * brake * ahead
    return torch.sqrt(squared).amin(-1)


def leaders_ahead(
    routed: RoutedScene,
    s: Tensor,
    *,
    agents: Tensor,
    present: Tensor,
) -> Leaders:
    """Leaders [B, V, 3] of vehicles once all agents have kept their velocity for
    LEADER_AT.

    Args:
        routed: the scenes with their routes.
        s: [B, V] m, where the vehicles are on these, and stay.
        agents: [B, N, 4] states.
        present: [B, N] bool.
    """
    times = torch.tensor(LEADER_AT, device=agents.device)
    return leaders(
        s,
        routed.points,
        agents=constant_velocity(agents, times),
        size=routed.size,
        present=present,
    )


def _light_features(
    routed: RoutedScene,
    state: LaneState,
    step: Tensor,
) -> list[Tensor]:
    """Of each light of the route: nearness, red, yellow, green, and the braking that
    stops at it."""
    colours = light_state_at(routed.light_state, routed.light, step=step)
    ahead = routed.light_s - state.s[..., None]
    counts = (routed.light >= 0) & (ahead > -1.0) & (ahead < 120.0)
    need = (state.v[..., None] ** 2 / (2 * ahead.clamp(min=1.0))).clamp(max=8.0)
    columns = [
        torch.where(counts, 1 - ahead / 120.0, 0.0),
        (counts & (colours == LIGHT_RED)).float(),
        (counts & (colours == LIGHT_YELLOW)).float(),
        (counts & (colours == LIGHT_GREEN)).float(),
        torch.where(counts & (colours != LIGHT_GREEN), need / 4, 0.0),
    ]
    return list(torch.stack(columns, -1).flatten(2).unbind(-1))


def _past_features(past: Tensor, v: Tensor, estimated: Tensor) -> list[Tensor]:
    """PAST + 4 features [B, V] of the second before the start; 0 where states are
    exact, which do not need them.

    The speed in each 0.1 s against the present one, then lateral position and heading
    0.5 s and 1 s ago.
    """
    ahead = torch.cat([torch.zeros_like(past[..., :1, 0]), past[..., 0]], -1)
    change = ((-ahead.diff(dim=-1) / DT - v[..., None]) / 2).clamp(-2, 2)
    _, left, heading = past[..., PAST // 2 - 1 :: PAST // 2, :].unbind(-1)
    columns = [change, left.clamp(-5, 5), 5 * heading.clamp(-1, 1)]
    return list((torch.cat(columns, -1) * estimated[:, None, None]).unbind(-1))


@fused(ROUTED, "B V")
def edge_features(routed: RoutedScene, state: LaneState) -> Tensor:
    """[B, V, V, EDGE] of each pair (i, j): j in i's frame, and where routes meet."""

    def of_pairs(value: Tensor) -> Tensor:
        """Value of j less that of i."""
        return value[:, None, :] - value[..., None]

    v = state.v
    cos = torch.cos(state.heading)[..., None]
    sin = torch.sin(state.heading)[..., None]
    dx = of_pairs(state.x)
    dy = of_pairs(state.y)
    along = cos * dx + sin * dy
    across = cos * dy - sin * dx
    turn = of_pairs(state.heading)
    vx = v[:, None, :] * torch.cos(turn) - v[..., None]
    vy = v[:, None, :] * torch.sin(turn)
    distance = torch.sqrt(dx**2 + dy**2 + 0.01)
    rest = routed.conflict_s - state.s[..., None]
    other = rest.transpose(1, 2)
    meet = routed.conflict & (rest > -3) & (other > -3)
    pace = v.clamp(min=1.0)
    arrival = rest / pace[..., None] - other / pace[:, None, :]
    meeting = [
        torch.exp(-rest.clamp(min=0) / 30),
        torch.exp(-other.clamp(min=0) / 30),
        torch.cos(routed.crossing),
        torch.sin(routed.crossing),
        torch.tanh(arrival / 3),
    ]
    features = [
        along / 30,
        across / 10,
        torch.cos(turn),
        torch.sin(turn),
        vx / 10,
        vy / 10,
        torch.exp(-distance / 20),
        -(along * vx + across * vy) / distance / 10,
        torch.exp(-distance / 5),
        meet.float(),
        *(torch.where(meet, value, 0.0) for value in meeting),
    ]
    return torch.stack(features, -1)
