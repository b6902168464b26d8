"""The observation of a learned ego: an ego-centred vector of OBSERVATION_SIZE numbers
of order one.

Blocks: ego (11), mission route ahead (12 x 5), lights (2 x 4), drivable border (5 x 5),
nearest agents (12 x 16), manoeuvres (15 x 2, see `prospects`).
"""

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.fused import fused
from e2rl.scenes.drivable_area import off_road, off_road_at
from e2rl.scenes.route import project
from e2rl.sim.dynamics import curvature_of
from e2rl.sim.mission import Mission, limit_at
from e2rl.sim.neighbours import (
    Neighbours,
    neighbours_of,
    relative_velocity,
    rotation_into,
)
from e2rl.sim.prospects import (
    ACCELERATIONS,
    OFFSETS,
    PROSPECTS,
    TIMES,
    WIDEST,
    Arc,
    Others,
    prospects,
)
from e2rl.sim.static import STATIC, FrenetPose, StaticScene, look_along, seen_from
from e2rl.sim.world import AGENTS, Agents

# m along the mission.
LOOK_AHEAD = (2.0, 4.0, 7.0, 10.0, 14.0, 19.0, 25.0, 32.0, 40.0, 50.0, 62.0, 75.0)
# m in the ego's frame.
PROBE_X = (-3.0, 0.0, 5.0, 11.0, 20.0)
PROBE_Y = (-5.0, -2.5, 0.0, 2.5, 5.0)
UNLIMITED = 12.0  # m/s, the limit that a policy reads at least where none is known
# The probe at the ego itself.
CENTRE = PROBE_X.index(0.0) * len(PROBE_Y) + PROBE_Y.index(0.0)
NEAREST = 12  # agents
# Scales.
SPEED = 15.0  # m/s
FAR = 40.0  # m
NEAR = 10.0  # m
TURNING = 0.5  # rad/s
PER_AGENT = 16  # numbers
LOOKED_AT = 6  # of them, whose motion manoeuvres are held against
ELAPSED = 10  # the number that tells the elapsed fraction of the episode
COLUMNS = (2, 2, 2, 1, 1, 1, 1, 1, 1)  # of the table `nearest`
OBSERVATION_SIZE = (
    11
    + 5 * len(LOOK_AHEAD)
    + 8
    + len(PROBE_X) * len(PROBE_Y)
    + PER_AGENT * NEAREST
    + PROSPECTS
)


class EgoState(NamedTuple):
    """The current egos of B scenes.

    step [B] int64; state [B, 4]: x, y, heading, speed; action [B, 2]: last executed
    acceleration and yaw rate; pose: Frenet pose on the mission; present [B] bool: still
    in the scene; been_on_road [B] bool: was on the road before, so off_road counts;
    start_s [B]: arc length at the start; inside [B, M] bool: agents that have
    overlapped the ego since they appeared, which is no contact.
    """

    step: Tensor
    state: Tensor
    action: Tensor
    pose: FrenetPose
    present: Tensor
    been_on_road: Tensor
    start_s: Tensor
    inside: Tensor

    def merged(
        self,
        other: "EgoState",
        function: Callable[[Tensor, Tensor], Tensor],
    ) -> "EgoState":
        """An EgoState of function(own, other's) of every tensor."""
        pose = FrenetPose(*map(function, self.pose, other.pose))
        rest = {
            name: function(value, getattr(other, name))
            for name, value in self._asdict().items()
            if name != "pose"
        }
        return EgoState(pose=pose, **rest)


def placed_ego(
    mission: Mission,
    state: Tensor,
    *,
    step: Tensor,
    action: Tensor,
    present: Tensor,
    place: Tensor | None,
    others: Tensor,
) -> EgoState:
    """The egos of B scenes on their missions, from where progress counts; who is
    present is on the road.

    Args:
        mission: of the scenes.
        state: [B, 4].
        step: [B].
        action: [B, 2], last executed.
        present: [B] bool.
        place: [B] m, arc length near which they are, None where it is unknown.
        others: [B, M], any tensor of the other agents.
    """
    hint = None if place is None else place[:, None]
    projected = project(state[:, None, :2], mission.points, hint=hint)
    pose = FrenetPose(*(value[:, 0] for value in projected))
    return EgoState(
        step=step,
        state=state,
        action=action,
        pose=pose,
        present=present,
        been_on_road=present,
        start_s=pose.s,
        inside=torch.zeros_like(others, dtype=torch.bool),
    )


EGO_STATE = (
    *("B:int64", "B 4!", "B 2!"),
    *("B", "B", "B"),
    *("B:bool", "B:bool", "B", "B M:bool"),
)
"""Shapes of an EgoState's tensors in fused functions."""


class ObservationConfig(NamedTuple):
    """The constants of the observation as tensors: arc lengths ahead [13] m, the last
    one 0; probes [25, 2] m; scales of an agent's features [11, 1]; light colours [3].
    """

    ahead: Tensor
    probes: Tensor
    agent: Tensor
    colours: Tensor


class Observed(NamedTuple):
    """An observation and what it shares with events and reward: neighbours, beyond [B]:
    m that the ego's centre is beyond the drivable border, limit [B]: speed limit at the
    ego [m/s], 0 unknown; features [B, OBSERVATION_SIZE], [B, 0] of a `glance`."""

    neighbours: Neighbours
    beyond: Tensor
    limit: Tensor
    features: Tensor


@cache
def observation_config(device: torch.device) -> ObservationConfig:
    """The ObservationConfig on a device (cached)."""

    scales = (FAR, NEAR, 1.0, 1.0, SPEED, SPEED, SPEED, 4.0, 2.5, 1.0, 1.0)
    tensor = partial(torch.tensor, device=device)
    return ObservationConfig(
        ahead=tensor((*LOOK_AHEAD, 0.0)),
        probes=torch.cartesian_prod(tensor(PROBE_X), tensor(PROBE_Y)),
        agent=tensor(scales)[:, None],
        colours=tensor((1, 2, 3)),
    )


def observe(
    static: StaticScene,
    ego: EgoState,
    agents: Agents,
    time: Tensor,
) -> Observed:
    """The observation of egos.

    Args:
        static: of the scenes.
        ego: the egos.
        agents: all others.
        time: [B], the elapsed fraction of the episode.
    """
    config = observation_config(ego.state.device)
    rotation = rotation_into(ego.state)
    neighbours = neighbours_of(
        ego.state,
        rotation,
        static=static,
        agents=agents,
    )
    border = _border(config, static, ego.state, rotation=rotation)
    route, limit = route_features(
        config,
        static,
        ego=ego,
        rotation=rotation,
    )
    near = nearest(static, neighbours)
    blocks = [
        ego_features(
            static,
            ego,
            limit=limit,
            time=time,
        ),
        route,
        light_features(
            config,
            static,
            step=ego.step,
            s=ego.pose.s,
        ),
        (border / 4).clamp(-1, 1),
        agent_features(config, ego, near=near),
        prospects(
            static,
            ego.state,
            pose=ego.pose,
            rotation=rotation,
            others=others_of(near),
        ),
    ]
    return Observed(neighbours, border[:, CENTRE], limit, torch.cat(blocks, -1))


@fused(STATIC, EGO_STATE, AGENTS, "B")
def features(
    static: StaticScene,
    ego: EgoState,
    agents: Agents,
    time: Tensor,
) -> Tensor:
    """The features [B, OBSERVATION_SIZE] of `observe`, alone.

    Args:
        static, ego, agents, time: of `observe`.
    """
    return observe(static, ego, agents, time).features


def glance(
    static: StaticScene,
    ego: EgoState,
    agents: Agents,
    time: Tensor,
) -> Observed:
    """`observe` without the features: what events and reward need, at a moment at which
    no policy looks.

    Args:
        static, ego, agents, time: of `observe`.
    """
    rotation = rotation_into(ego.state)
    neighbours = neighbours_of(
        ego.state,
        rotation,
        static=static,
        agents=agents,
    )
    beyond = off_road(ego.state[:, None, :2], static.field, origin=static.origin)
    limit = limit_at(static.mission, ego.pose.s)
    return Observed(neighbours, beyond[:, 0], limit, features=ego.state[:, :0])


def _border(
    config: ObservationConfig,
    static: StaticScene,
    state: Tensor,
    *,
    rotation: Tensor,
) -> Tensor:
    """[B, 25] m that the probes of egos [B, 4] are beyond the drivable border."""
    if not torch.compiler.is_compiling():
        probes = config.probes.expand(len(rotation), -1, -1)
        places = torch.baddbmm(state[:, None, :2], probes, rotation)
        return off_road(places, static.field, origin=static.origin)
    ahead, left = config.probes.unbind(1)
    x, y = (
        state[:, k, None]
        + ahead * rotation[:, 0, k, None]
        + left * rotation[:, 1, k, None]
        for k in (0, 1)
    )
    return off_road_at(
        x,
        y,
        field=static.field,
        origin=static.origin,
    )


def ego_features(
    static: StaticScene,
    ego: EgoState,
    *,
    limit: Tensor,
    time: Tensor,
) -> Tensor:
    """[B, 11]: speed, last action (2), offset and heading to the mission (3), speed
    limit, distance to the map's end, size (2), elapsed fraction of the episode.

    Args:
        static: of the scenes.
        ego: the egos.
        limit: [B] m/s, where they are.
        time: [B], the elapsed fraction.
    """
    pose = ego.pose
    speed = ego.state[:, 3]
    length, width = static.size.unbind(1)
    turned = ego.state[:, 2] - pose.heading
    features = [
        speed / SPEED,
        ego.action[:, 0] / 4,
        ego.action[:, 1],
        (pose.d / 3).clamp(-2, 2),
        turned.sin(),
        turned.cos(),
        read_as(limit, speed) / SPEED,
        ((static.mission.end - pose.s) / 100).clamp(0, 1),
        length / 5,
        width / 2,
        time,
    ]
    return torch.stack(features, -1)


def read_as(limit: Tensor, speed: Tensor) -> Tensor:
    """Speed limits [...] m/s as a policy reads them: UNLIMITED where unknown (0), or
    the ego's speed, if higher."""
    return torch.where(limit > 0, limit, speed.clamp(min=UNLIMITED))


def route_features(
    config: ObservationConfig,
    static: StaticScene,
    *,
    ego: EgoState,
    rotation: Tensor,
) -> tuple[Tensor, Tensor]:
    """[B, 12 * 5]: mission points ahead in the ego's frame (2), relative heading,
    curvature, speed limit; and the speed limit at the ego [B] m/s.

    Args:
        config: where to look.
        static: of the scenes.
        ego: the egos.
        rotation: [B, 2, 2], into their frames.
    """
    ahead = look_along(static, ego.pose.s[:, None] + config.ahead)
    x, y = seen_from(
        ego.state,
        rotation,
        x=ahead.x,
        y=ahead.y,
    )
    columns = [
        x / FAR,
        y / NEAR,
        (ahead.heading - ego.state[:, 2:3]).sin(),
        (10 * ahead.curvature).clamp(-2, 2),
        read_as(ahead.limit, ego.state[:, 3:]) / SPEED,
    ]
    features = torch.stack(columns, -1)[:, :-1].clamp(-5, 5)
    return features.flatten(1), ahead.limit[:, -1]


def light_features(
    config: ObservationConfig,
    static: StaticScene,
    *,
    step: Tensor,
    s: Tensor,
) -> Tensor:
    """[B, 2 * 4]: the mission's lights red, yellow, green (one-hot while ahead) and
    nearness (1 at the line, 0 far).

    Args:
        config: the colours.
        static: of the scenes.
        step: [B].
        s: [B] m, where the egos are on their missions.
    """
    ahead = static.mission.light_s - s[:, None]
    counts = (static.mission.light >= 0) & (ahead > -2)
    state = static.lights[static.row[:, 0], step.clamp(0, static.lights.shape[1] - 1)]
    colours = state[..., None] == config.colours
    near = (-ahead.clamp(min=0) / 30).exp()
    features = torch.cat([colours.to(s.dtype), near[..., None]], -1)
    return (features * counts[..., None]).flatten(1)


def nearest(static: StaticScene, others: Neighbours) -> Tensor:
    """Table [B, 12, NEAREST] of the nearest agents: position (2), direction (2), half
    sizes (2), gap, speed, acceleration, turn rate, whether it is a vehicle, presence;
    zeros where there are fewer."""
    states, present, accel, turn_rate = others.agents
    scalars = (others.gap, states[..., 3], accel, turn_rate, static.vehicle, present)
    columns = [others.position, others.direction, static.half_size]
    columns += [value[:, None] for value in scalars]
    pad = torch.nn.functional.pad
    apart = others.position.square().sum(1).masked_fill(~present, torch.inf)
    apart = pad(apart, (0, NEAREST), value=torch.inf)
    index = apart.topk(NEAREST, dim=1, largest=False).indices[:, None]
    # Column by column: gathered whole, the table takes ten times as long, compiled.
    picked = [
        pad(column.to(apart.dtype), (0, NEAREST)).gather(
            2, index.expand(-1, column.shape[1], -1)
        )
        for column in columns
    ]
    return torch.cat(picked, 1)


def agent_features(config: ObservationConfig, ego: EgoState, near: Tensor) -> Tensor:
    """[B, 12 * PER_AGENT] of the table `nearest`: presence, relative pose (4) and
    velocity (2), speed, acceleration, size (2), whether it is a vehicle, gap, time and
    distance of the closest approach at constant velocities, and turn rate; absent
    agents are zeros."""
    local, direction, half, gap, speed, accel, turn_rate, vehicle, present = near.split(
        COLUMNS, 1
    )
    velocity = relative_velocity(ego.state, speed, direction)
    closing = -(local * velocity).sum(1, True)
    time = (closing / (velocity.square().sum(1, True) + 1e-3)).clamp(0, 8)
    miss = (local + velocity * time).norm(
        dim=1,
        keepdim=True,
    )
    motion = torch.cat([local, direction, velocity, speed, accel, half, vehicle], 1)
    columns = [
        present,
        (motion / config.agent).clamp(-5, 5),
        (gap / NEAR).clamp(-1, 2),
        torch.cat([-time / 2, -miss / 5], 1).exp(),
        (turn_rate / TURNING).clamp(-5, 5),
    ]
    return (torch.cat(columns, 1) * present).transpose(1, 2).flatten(1)


def others_of(near: Tensor) -> Others:
    """The LOOKED_AT nearest agents of the table `nearest`."""
    local, direction, half, _, speed, accel, turn_rate, _, present = (
        column.squeeze(1) for column in near[..., :LOOKED_AT].split(COLUMNS, 1)
    )
    return Others(
        local,
        direction,
        half_size=half,
        speed=speed,
        arc=Arc(accel, curvature_of(turn_rate, speed)),
        present=present > 0,
    )


class Entry(NamedTuple):
    """A number of the observation: its name; number times scale is in unit ("" for
    fractions, sines and flags)."""

    name: str
    unit: str = ""
    scale: float = 1.0


EGO = (
    Entry("speed", "m/s", scale=SPEED),
    Entry("acceleration", "m/s^2", scale=4.0),
    Entry("yaw_rate", "rad/s"),
    Entry("offset", "m", scale=3.0),
    Entry("heading_sin"),
    Entry("heading_cos"),
    Entry("limit", "m/s", scale=SPEED),
    Entry("left", "m", scale=100.0),
    Entry("length", "m", scale=5.0),
    Entry("width", "m", scale=2.0),
    Entry("elapsed"),
)
POINT = (
    Entry("x", "m", scale=FAR),
    Entry("y", "m", scale=NEAR),
    Entry("heading_sin"),
    Entry("curvature", "1/m", scale=0.1),
    Entry("limit", "m/s", scale=SPEED),
)
LIGHT = (Entry("red"), Entry("yellow"), Entry("green"), Entry("nearness"))
AGENT = (
    Entry("present"),
    Entry("x", "m", scale=FAR),
    Entry("y", "m", scale=NEAR),
    Entry("heading_cos"),
    Entry("heading_sin"),
    Entry("velocity_x", "m/s", scale=SPEED),
    Entry("velocity_y", "m/s", scale=SPEED),
    Entry("speed", "m/s", scale=SPEED),
    Entry("acceleration", "m/s^2", scale=4.0),
    Entry("half_length", "m", scale=2.5),
    Entry("half_width", "m", scale=1.0),
    Entry("vehicle"),
    Entry("gap", "m", scale=NEAR),
    Entry("approach_time"),
    Entry("approach_distance"),
    Entry("turn_rate", "rad/s", scale=TURNING),
)


def observation_layout() -> list[Entry]:
    """The OBSERVATION_SIZE entries of an observation, in order, named
    `block.number.quantity` (docs/guide/policies.md)."""
    manoeuvres = [
        f"manoeuvre.{accel:+g}.{offset:+g}"
        for accel in ACCELERATIONS
        for offset in OFFSETS
    ]
    probes = [f"border.{x:+g}.{y:+g}" for x in PROBE_X for y in PROBE_Y]
    last = TIMES[-1] + TIMES[0]
    blocks = [
        _named("ego", EGO),
        *(_named(f"route.{k}", POINT) for k in range(len(LOOK_AHEAD))),
        *(_named(f"light.{k}", LIGHT) for k in range(2)),
        [Entry(name, "m", scale=4.0) for name in probes],
        *(_named(f"agent.{k}", AGENT) for k in range(NEAREST)),
        [Entry(f"{name}.gap", "m", scale=WIDEST) for name in manoeuvres],
        [Entry(f"{name}.contact", "s", scale=last) for name in manoeuvres],
    ]
    return [entry for block in blocks for entry in block]


def _named(block: str, entries: tuple[Entry, ...]) -> list[Entry]:
    return [entry._replace(name=f"{block}.{entry.name}") for entry in entries]
