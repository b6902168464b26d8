"""A route follower that reads only the observation: the learned ego starts from it and
corrects it.

Steering is pure pursuit of the mission. The acceleration is the minimum over IDM behind
every agent in the corridor, IDM behind stop lines that bind, and the speed caps by
limits and curves. Pure functions of e2rl.sim.observation.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.fused import fused
from e2rl.scenes.route import first_least
from e2rl.sim.leaders import GATE_MARGIN, IDMParameters, idm_acceleration
from e2rl.sim.observation import (
    FAR,
    LOOK_AHEAD,
    NEAR,
    NEAREST,
    OBSERVATION_SIZE,
    PER_AGENT,
    PROBE_X,
    PROBE_Y,
    SPEED,
)
from e2rl.sim.prospects import ACCELERATIONS, OFFSETS, PROSPECTS, WIDEST

EGO = slice(0, 11)
LAST_ACTION = (1, 2)
ROUTE = slice(11, 11 + 5 * len(LOOK_AHEAD))
LIGHTS = slice(ROUTE.stop, ROUTE.stop + 8)
PROBED = LIGHTS.stop + len(PROBE_X) * len(PROBE_Y)
AGENTS = slice(PROBED, PROBED + PER_AGENT * NEAREST)
ROOMS = slice(AGENTS.stop, AGENTS.stop + PROSPECTS // 2)
MILD = slice(ACCELERATIONS.index(-1.0), ACCELERATIONS.index(1.0) + 1)

EVASION = "evasion"  # key of the action that takes the reference's place in danger
PURSUIT_TIME = 1.5  # s of look-ahead of the pursuit
PURSUIT_MIN = 6.0  # m
PURSUIT_MAX = 30.0  # m
BRAKING = 2.5  # m/s^2, comfortable
HARDEST_BRAKING = 7.0  # m/s^2
STANDSTILL_GAP = 3.0  # m
DRIVER = IDMParameters(
    headway=1.2,
    standstill_gap=STANDSTILL_GAP,
    acceleration=1.5,
    braking=BRAKING,
    exponent=4.0,
)
COOLNESS = 0.99  # of the ACC model: 0 is IDM
LATERAL = 2.5  # m/s^2 in curves
REACTION = 0.5  # s in which a speed cap is kept
LINE_GAP = 1.0  # m kept to a stop line
ALIGNED = 0.7  # least cosine between path and heading of who drives the ego's way
UNCAPPED = 1e3  # m/s


def follow(observation: Tensor) -> Tensor:
    """[..., 4] at observation [..., D]: the action (m/s^2, rad/s); the bound, an
    acceleration (m/s^2); the room in m.

    The bound is what IDM allows behind whoever is ahead and drives the ego's way, or is
    no vehicle; inf without one. The room is the least gap that going on with -1 or 1
    m/s^2 leaves within the observation's manoeuvres.
    """
    rows = reference_rows(observation.reshape(-1, OBSERVATION_SIZE))
    return rows.view(*observation.shape[:-1], 4)


@fused(f"B {OBSERVATION_SIZE}")
def reference_rows(observation: Tensor) -> Tensor:
    """`follow` [B, 4] at observations [B, D]."""
    ego = observation[..., EGO]
    route = observation[..., ROUTE].unflatten(-1, (len(LOOK_AHEAD), 5))
    speed = ego[..., 0] * SPEED
    path = torch.stack([route[..., 0] * FAR, route[..., 1] * NEAR], -1)
    desired = (ego[..., 6] * SPEED).clamp(min=1.0)
    leaders = _leaders(observation, path)
    wanted = _following(speed[..., None], desired[..., None], leaders).amin(-1)
    least = (-speed / REACTION).clamp(
        min=-HARDEST_BRAKING
    )  # no braking at standstill, as in recordings
    most = torch.minimum(wanted, speed_cap_acceleration(route, speed)).clamp(
        max=DRIVER.acceleration
    )
    uncapped = torch.full_like(desired, UNCAPPED)[..., None]
    behind = _following(speed[..., None], uncapped, leaders)
    bound = torch.where(leaders.binding, behind, torch.inf).amin(-1)
    rooms = observation[..., ROOMS].unflatten(-1, (len(ACCELERATIONS), len(OFFSETS)))
    room = WIDEST * rooms[..., MILD, OFFSETS.index(0.0)].amin(-1)
    accel = torch.maximum(most, least)
    yaw_rate = speed * pursuit_curvature(path, speed)
    return torch.stack(
        [
            accel,
            yaw_rate,
            torch.maximum(bound, least),
            room,
        ],
        -1,
    )


class Leaders(NamedTuple):
    """Agents and stop lines along the path [..., NEAREST + 2]: free gap m, inf for
    none; speed along the path m/s and acceleration m/s^2; binding: the bound of
    `follow` holds behind it."""

    gap: Tensor
    speed: Tensor
    acceleration: Tensor
    binding: Tensor


def _following(
    speed: Tensor,
    desired: Tensor,
    leaders: Leaders,
) -> Tensor:
    """Acceleration [..., K] of the ACC model (Kesting, Treiber and Helbing 2010) behind
    K leaders, at speed and desired speed [..., 1] m/s.

    After a cut-in, IDM brakes fully for a short gap even if the leader pulls away. An
    IDM acceleration below that of the constant-acceleration heuristic, which only
    avoids the crash, is therefore raised towards it.
    """
    gap = leaders.gap
    leading = leaders.speed
    idm = idm_acceleration(
        speed,
        desired,
        gap=gap,
        leader_speed=leading,
        driver=DRIVER,
        improved=True,
    )
    space = gap.clamp(0.5, 1e3)
    steady = leaders.acceleration.clamp(-HARDEST_BRAKING, DRIVER.acceleration)
    stops_first = leading * (speed - leading) <= -2 * space * steady
    halting = speed**2 * steady / (leading**2 - 2 * space * steady).clamp(min=1e-3)
    closing = steady - (speed - leading).clamp(min=0) ** 2 / (2 * space)
    least = torch.where(stops_first, halting, closing)
    soft = least + BRAKING * ((idm - least) / BRAKING).tanh()
    mixed = (1 - COOLNESS) * idm + COOLNESS * soft
    return torch.where((idm < least) & gap.isfinite(), mixed, idm)


def pursuit_curvature(path: Tensor, speed: Tensor) -> Tensor:
    """Curvature [...] 1/m of the circle through the ego and the point of path [..., K,
    2] PURSUIT_TIME ahead."""
    ahead = path.new_tensor(LOOK_AHEAD)
    reach = (PURSUIT_TIME * speed).clamp(PURSUIT_MIN, PURSUIT_MAX)
    high = (ahead < reach[..., None]).sum(-1).clamp(1, len(LOOK_AHEAD) - 1)
    fraction = (reach - ahead[high - 1]) / (ahead[high] - ahead[high - 1])

    def point(index: Tensor) -> Tensor:
        return path.gather(-2, index[..., None, None].expand(*index.shape, 1, 2))[
            ..., 0, :
        ]

    aim = torch.lerp(point(high - 1), point(high), fraction[..., None])
    return 2 * aim[..., 1] / aim.square().sum(-1).clamp(min=1.0)


def speed_cap_acceleration(route: Tensor, speed: Tensor) -> Tensor:
    """Acceleration [...] that reaches the speed cap by limits and curves ahead within
    REACTION."""
    curvature = route[..., 3].abs() / 10
    limit = route[..., 4] * SPEED
    squared = torch.minimum(LATERAL / curvature.clamp(min=1e-3), limit**2)
    ahead = route.new_tensor(LOOK_AHEAD)
    room = (ahead - speed[..., None] * REACTION).clamp(min=0)
    allowed = (squared + 2 * BRAKING * room).amin(-1).sqrt()
    return (allowed - speed) / REACTION


def _leaders(observation: Tensor, path: Tensor) -> Leaders:
    """The agents, and after them the stop lines, along path [..., K, 2]."""
    ego = observation[..., EGO]
    half_length = 2.5 * ego[..., 8, None]
    half_width = ego[..., 9, None]
    agents = observation[..., AGENTS].unflatten(-1, (NEAREST, PER_AGENT))
    position = torch.stack([agents[..., 1] * FAR, agents[..., 2] * NEAR], -1)
    along, apart, direction = _on_path(position, path)
    cos = agents[..., 3]
    sin = agents[..., 4]
    aligned = cos * direction[..., 0] + sin * direction[..., 1]
    across = (sin * direction[..., 0] - cos * direction[..., 1]).abs()
    length = 2.5 * agents[..., 9]
    width = agents[..., 10]
    inside = apart < across * length + aligned.abs() * width + half_width + GATE_MARGIN
    leads = inside & (along > 0) & (agents[..., 0] > 0)
    gap = along - aligned.abs() * length - across * width - half_length
    line = stop_lines(observation, ego[..., 0] * SPEED)
    halt = line - half_length - LINE_GAP + STANDSTILL_GAP
    still = torch.zeros_like(halt)
    speed = (agents[..., 7] * SPEED * aligned).clamp(min=0)
    acceleration = 4 * agents[..., 8] * aligned
    binding = leads & ((aligned > ALIGNED) | (agents[..., 11] < 0.5))
    return Leaders(
        torch.cat([gap.masked_fill(~leads, torch.inf), halt], -1),
        torch.cat([speed, still], -1),
        acceleration=torch.cat([acceleration, still], -1),
        binding=torch.cat([binding, torch.zeros_like(halt, dtype=torch.bool)], -1),
    )


def _on_path(position: Tensor, path: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points position [..., A, 2] at the nearest segment of the ego's origin + path
    [..., K, 2]: metres along, metres apart, each [..., A], and the segment's direction
    [..., A, 2]."""
    corner = torch.cat([torch.zeros_like(path[..., :1, :]), path], -2)
    leg = corner.diff(dim=-2)
    length = leg.norm(dim=-1).clamp(min=1e-3)
    unit = (leg / length[..., None])[..., None, :, :]
    offset = position[..., :, None, :] - corner[..., None, :-1, :]
    t = torch.minimum((offset * unit).sum(-1).clamp(min=0), length[..., None, :])
    distance = (offset - t[..., None] * unit).norm(dim=-1)
    apart = distance.amin(-1)
    index = first_least(distance)
    before = (length.cumsum(-1) - length)[..., None, :]
    along = (before + t).gather(-1, index[..., None])[..., 0]
    direction = unit.expand(*t.shape, 2).gather(
        -2, index[..., None, None].expand(*index.shape, 1, 2)
    )[..., 0, :]
    return along, apart, direction


def stop_lines(observation: Tensor, speed: Tensor) -> Tensor:
    """Metres [..., 2] to the stop lines that bind: red if twice BRAKING halts before
    it, yellow if BRAKING does."""
    light = observation[..., LIGHTS].unflatten(-1, (2, 4))
    ahead = -30 * light[..., 3].clamp(min=1e-4).log()
    needed = speed[..., None] ** 2 / (2 * ahead.clamp(min=1e-3))
    red = (light[..., 0] > 0) & (needed < 2 * BRAKING)
    yellow = (light[..., 1] > 0) & (needed < BRAKING)
    return ahead.masked_fill(~(red | yellow) | (ahead <= 0), torch.inf)
