"""A vehicle driven again along its own way by a competent driver, in traffic that is replayed (docs/verdicts.md).

Shapes: B rollouts, T + 1 states of DT, N others. The way is the path that the vehicle drove, straight on from its end.
The driver keeps the recorded acceleration until it reacts, then what it asks for; it never steers and never drives
faster than recorded.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.scene.boxes import separation
from e2rl.scene.recording import DT
from e2rl.scene.route import SPACING, project
from e2rl.verdicts.drivers import Driver, Observation

STRAIGHT = 60.0  # m by which a way goes on straight


class Tracks(NamedTuple):
    """Recorded motion of vehicles: states [B, T+1, N, 4], size [B, N, 2], present [B, T+1, N] bool."""

    states: Tensor
    size: Tensor
    present: Tensor


class Along(NamedTuple):
    """Others seen along a way, each [T+1, B, N]: rear (arc length of its near end, m), speed and acceleration along the
    way, lateral gap (m between the facing sides), lateral speed towards the way, length along the way.

    Absent ones, and those that never enter the way, are at an infinite distance.
    """

    rear: Tensor
    speed: Tensor
    acceleration: Tensor
    lateral_gap: Tensor
    lateral_speed: Tensor
    length: Tensor


def driven_length(states: Tensor) -> Tensor:
    """Arc length [B, T+1] m at each step of a way states [B, T+1, 4], 0 at its start."""
    return torch.nn.functional.pad(states[..., :2].diff(dim=1).norm(dim=-1).cumsum(-1), (1, 0))


def poses(states: Tensor, s: Tensor) -> Tensor:
    """Poses [B, K, 3] at arc lengths s [B, K] of a way states [B, T+1, 4], straight on beyond its end."""
    length = driven_length(states)
    after = torch.searchsorted(length, s.contiguous(), right=True).clamp(1, length.shape[1] - 1)
    low, high = length.gather(1, after - 1), length.gather(1, after)
    share = ((s - low) / (high - low).clamp(min=1e-6)).clamp(0, 1)[..., None]
    first, second = (states.gather(1, index[..., None].expand(-1, -1, 4)) for index in (after - 1, after))
    turn = torch.remainder(second[..., 2] - first[..., 2] + torch.pi, 2 * torch.pi) - torch.pi
    heading = first[..., 2] + share[..., 0] * turn
    beyond = (s - length[:, -1:]).clamp(min=0)[..., None]
    ahead = torch.stack([heading.cos(), heading.sin()], -1)
    return torch.cat([torch.lerp(first[..., :2], second[..., :2], share) + beyond * ahead, heading[..., None]], -1)


def along_way(states: Tensor, width: Tensor, others: Tracks) -> Along:
    """Others seen along the way states [B, T+1, 4] of a vehicle of `width` [B] m."""
    reach = STRAIGHT + (driven_length(states).amax().item() if len(states) else 0.0)
    vertices = SPACING * torch.arange(int(reach / SPACING) + 2, device=states.device, dtype=states.dtype)
    route = poses(states, vertices.expand(len(states), -1))[..., :2]
    s, d, heading = project(others.states[..., :2].flatten(1, 2), route)
    s, d, heading = (value.unflatten(1, others.present.shape[1:]) for value in (s, d, heading))
    turn, speed = others.states[..., 2] - heading, others.states[..., 3]
    cos, sin = turn.cos(), turn.sin()
    half = others.size[:, None] / 2
    extent = half[..., 0] * cos.abs() + half[..., 1] * sin.abs()
    side = half[..., 0] * sin.abs() + half[..., 1] * cos.abs()
    gap = d.abs() - side - width[:, None, None] / 2
    enters = ((gap <= 0) & others.present).any(1, keepdim=True)
    away = ~others.present | ~enters
    change = torch.nn.functional.pad(speed.diff(dim=1) / DT, (0, 0, 1, 0)) * cos
    values = (
        (s - extent).masked_fill(away, torch.inf),
        speed * cos,
        change,
        gap.masked_fill(away, torch.inf),
        -d.sign() * speed * sin,
        2 * extent,
    )
    return Along(*(value.transpose(0, 1) for value in values))


def redrive(driver: Driver, states: Tensor, size: Tensor, others: Along) -> Tensor:
    """States [B, T+1, 4] of a vehicle whose way is states [B, T+1, 4] and whose driver sees `others`; size [B, 2].

    It reacts to each of the others as if that were alone, and brakes for the one that asks most.
    """
    recorded = states[..., 3].diff(dim=1) / DT
    speed, s = states[:, 0, 3], torch.zeros_like(states[:, 0, 3])
    acceleration, reacted = torch.zeros_like(speed), torch.zeros_like(speed, dtype=torch.bool)
    memory = driver.init(others.rear[0])
    length = size[:, :1].expand_as(others.rear[0])
    way, speeds = [s], [speed]
    for t in range(recorded.shape[1]):
        gap = others.rear[t] - (s + size[:, 0] / 2)[:, None]
        side = others.lateral_gap[t]
        seen = Observation(
            speed[:, None].expand_as(gap),
            acceleration[:, None].expand_as(gap),
            gap,
            others.speed[t],
            others.acceleration[t],
            side,
            others.lateral_speed[t],
            side <= 0,
            length,
            others.length[t],
        )
        memory, wanted = driver.step(memory, seen)
        asked = wanted.amin(1)
        reacted = reacted | (asked < 0)
        chosen = torch.where(reacted, torch.minimum(asked, recorded[:, t]), recorded[:, t])
        after = (speed + chosen * DT).clamp(min=0)
        acceleration, s, speed = (after - speed) / DT, s + (speed + after) / 2 * DT, after
        way.append(s)
        speeds.append(speed)
    way_driven, speed_driven = torch.stack(way, 1), torch.stack(speeds, 1)
    return torch.cat([poses(states, way_driven), speed_driven[..., None]], -1)


def contacts(states: Tensor, size: Tensor, others: Tracks) -> Tensor:
    """Bool [B, T+1, N]: a vehicle at states [B, T+1, 4] of size [B, 2] overlaps each of the others."""
    apart = separation(states[:, :, None], size[:, None, None], others.states, others.size[:, None])
    return (apart < 0) & others.present
