"""Candidates of a planner: speed profiles on lateral moves beside the mission, driven
by the unicycle."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from e2rl.planners.ego import PLAN_STEPS, RETURN_LENGTH
from e2rl.planners.path import LEAST_STRETCH, RoutePath, fading
from e2rl.planners.profiles import NODES, PLAN_DT, capped, upsample
from e2rl.run.fused import fused, running_sum
from e2rl.scenes.recording import DT
from e2rl.scenes.route import interpolate
from e2rl.sim import dynamics
from e2rl.sim.dynamics import wrap

FIRST = round(1.0 / PLAN_DT)  # nodes of the first acceleration of a profile: 1 s
MAX_YAW_RATE = 1.6  # rad/s, the simulator's bound
CELL = 1.0  # m between entries of the table of a mission's headings
REACH = int(dynamics.MAX_SPEED * PLAN_STEPS * DT / CELL) + 1  # entries of it


class Candidates(NamedTuple):
    """C candidates of each of B scenes: states [B, C, PLAN_STEPS, 4] at steps 1..;
    distance [B, C] m along the mission to their end; shift [B, C] m beside the mission
    where they lead."""

    states: Tensor
    distance: Tensor
    shift: Tensor


class Moves(NamedTuple):
    """N moves: speed [PLAN_STEPS + 1, N] m/s at steps 0..; to shift [N] m beside the
    mission; time [N] s that they take at the present speed; scene [N] int64, of B."""

    speed: Tensor
    shift: Tensor
    time: Tensor
    scene: Tensor


class Starts(NamedTuple):
    """Where moves start in B scenes: states [B, 4]; d [B] m beside the mission and
    turned [B] rad off it; headings [B, REACH] rad, of `heading_table`."""

    states: Tensor
    d: Tensor
    turned: Tensor
    headings: Tensor


def speed_profiles(
    speed: Tensor,
    accelerations: Tensor,
    *,
    caps: Tensor,
    braking: float,
) -> Tensor:
    """Returns speeds [B, L, PLAN_STEPS + 1] every DT.

    Args:
        speed: [B] m/s, now.
        accelerations: [L, 2] m/s^2, in the first second and after it.
        caps: [B, K], squared speeds of `MissionPath.speed_caps`.
        braking: m/s^2 by which the caps are kept where a profile does not brake harder
            itself.
    """
    node = torch.arange(NODES, device=speed.device)
    rate = torch.where(node < FIRST, accelerations[:, :1], accelerations[:, 1:])
    start = speed[:, None, None].expand(-1, len(accelerations), 1)
    wanted = torch.cat([start, dynamics.bounded_speed(start, rate * PLAN_DT)], -1)
    return upsample(
        capped(
            wanted,
            caps,
            slope=braking * PLAN_DT,
        )
    )


def drive(
    start: Tensor,
    path: RoutePath,
    *,
    speed: Tensor,
    shift: Tensor,
    time: Tensor,
) -> Candidates:
    """Returns the C = L S Candidates of L speed profiles on S lateral moves each.

    A move leads `shift` m beside the mission over max(RETURN_LENGTH, time v) m, as
    `RoutePath` returns to its route. Its headings become yaw rates, within MAX_YAW_RATE
    and the tyres' grip, which braking shares; the unicycle makes states of them.

    Args:
        start: states [B, 4].
        path: of these states.
        speed: [B, L, PLAN_STEPS + 1] m/s, the profiles, of speeds that vehicles have.
        shift: [B, L, S] m, or what broadcasts to it.
        time: [B, L, S] s, or what broadcasts to it.
    """
    batch, profiles, ticks = speed.shape
    moves = shift.shape[-1]
    shape = (batch, profiles, moves)
    count = profiles * moves
    scene = torch.arange(batch, device=start.device).repeat_interleave(count)
    every = speed.permute(2, 0, 1)[..., None].expand(ticks, *shape)
    states, distance = driven(
        Moves(
            every.reshape(ticks, -1),
            shift.expand(shape).reshape(-1),
            time=time.expand(shape).reshape(-1),
            scene=scene,
        ),
        Starts(
            start,
            path.d,
            turned=path.turned,
            headings=heading_table(path),
        ),
    )
    return Candidates(
        states.unflatten(-1, (batch, count)).permute(2, 3, 1, 0),
        distance.view(batch, count),
        shift=shift.expand(shape).flatten(1),
    )


@fused(
    (f"{PLAN_STEPS + 1} N", "N", "N", "N:int64"),
    ("B 4", "B", "B", f"B {REACH}"),
)
def driven(moves: Moves, starts: Starts) -> tuple[Tensor, Tensor]:
    """Returns the states [4, PLAN_STEPS, N] of `drive`, and the distance [N] m along
    the mission to their end."""
    speed, shift, time, scene = moves
    start, d, turned, headings = starts
    mean = (speed[1:] + speed[:-1]) / 2
    steps = mean * DT
    ahead = torch.cat([torch.zeros_like(steps[:1]), running_sum(steps)])
    start = start[scene]
    offset, slope = fading(
        d[scene] - shift,
        turned[scene],
        length=(time * start[:, 3]).clamp(min=RETURN_LENGTH),
        ahead=ahead,
    )
    low, high, _ = between(headings, ahead / CELL, scene)
    inner = (1 - (high - low) / CELL * (shift + offset)).clamp(min=LEAST_STRETCH)
    stretch = torch.hypot(inner, slope)
    along = running_sum(2 * steps / (stretch[1:] + stretch[:-1]))
    heading = torch.lerp(*between(headings, along / CELL, scene))
    accel = (speed[1:] - speed[:-1]) / DT
    grip = (dynamics.MAX_LATERAL**2 - accel.square()).clamp(min=0).sqrt()
    bound = torch.minimum(grip / mean.clamp(min=1e-3), dynamics.yaw_rate_bound(mean))
    turn = steer(
        turned[scene],
        heading + torch.atan(slope[1:] / inner[1:]),
        bound=bound.clamp(max=MAX_YAW_RATE) * DT,
    )
    heading = start[:, 2] + running_sum(turn)
    middle = heading - turn / 2
    x = start[:, 0] + running_sum(steps * middle.cos())
    y = start[:, 1] + running_sum(steps * middle.sin())
    return torch.stack([x, y, wrap(heading), speed[1:]]), along[-1]


def steer(
    heading: Tensor,
    aim: Tensor,
    bound: Tensor,
) -> Tensor:
    """Turns [T, ...] rad of each step from heading [...] to aim [T, ...] rad, within
    bound [T, ...], which broadcasts. What a bound withholds is made up later."""
    turns = []
    for target, most in zip(aim, bound, strict=True):
        turn = torch.clamp(target - heading, -most, most)
        heading = heading + turn
        turns.append(turn)
    return torch.stack(turns)


def between(
    table: Tensor,
    place: Tensor,
    scene: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """`between_entries` of rows scene [N] of a table [B, K] at places [..., N]."""
    entries = table.shape[-1]
    place = place.clamp(0, entries - 1.001)
    index = place.long()
    flat = table.flatten()
    first = scene * entries + index
    return flat[first], flat[first + 1], place - index


def heading_table(path: RoutePath) -> Tensor:
    """Headings [B, REACH] of the missions every CELL m ahead, relative to the heading
    at the ego's place, unwrapped."""
    grid = CELL * torch.arange(REACH, device=path.s.device, dtype=path.s.dtype)
    heading = interpolate(path.route, path.s[:, None] + grid)[1]
    return pad(wrap(heading.diff(dim=-1)).cumsum(-1), (1, 0))
