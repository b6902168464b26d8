"""The observation of a learned ego: an ego-centred vector of OBSERVATION_SIZE numbers
of order one.

Blocks: ego (11), mission route ahead (12 x 5), lights (2 x 4), drivable border (5 x 5),
nearest agents (12 x 16), manoeuvres (15 x 2, see `prospects`).
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.run.fused import fused
from e2rl.scenes.drivable_area import off_road, off_road_at
from e2rl.scenes.route import project
from e2rl.sim.dynamics import Arc, curvature_of
from e2rl.sim.mission import Mission, limit_at
from e2rl.sim.neighbours import Neighbours, neighbours_of, rotation_into
from e2rl.sim.prospects import (
    ACCELERATIONS,
    OFFSETS,
    PROSPECTS,
    TIMES,
    WIDEST,
    Others,
    prospects,
)
from e2rl.sim.static import STATIC, FrenetPose, StaticScene, look_along, seen_from
from e2rl.sim.world import AGENTS, Agents

LOOK_AHEAD = (
    2.0,
    4.0,
    7.0,
    10.0,
    14.0,
    19.0,
    25.0,
    32.0,
    40.0,
    50.0,
    62.0,
    75.0,
)  # m along the mission
PROBE_X, PROBE_Y = (
    (-3.0, 0.0, 5.0, 11.0, 20.0),
    (-5.0, -2.5, 0.0, 2.5, 5.0),
)  # m in the ego's frame
UNLIMITED = 12.0  # m/s, the limit that a policy reads at least where none is known
CENTRE = PROBE_X.index(0.0) * len(PROBE_Y) + PROBE_Y.index(
    0.0
)  # the probe at the ego itself
NEAREST = 12  # agents
SPEED, FAR, NEAR, TURNING = 15.0, 40.0, 10.0, 0.5  # scales: m/s, m, m, rad/s
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
        self, other: "EgoState", function: Callable[[Tensor, Tensor], Tensor]
    ) -> "EgoState":
        """An EgoState of function(own, other's) of every tensor."""
        pose = FrenetPose(*map(function, self.pose, other.pose))
        names = [name for name in self._fields if name != "pose"]
        return EgoState(
            pose=pose,
            **{
                name: function(getattr(self, name), getattr(other, name))
                for name in names
            },
        )


def placed_ego(
    mission: Mission,
    step: Tensor,
    state: Tensor,
    action: Tensor,
    present: Tensor,
    on_road: Tensor,
    place: Tensor | None,
    agents: Tensor,
) -> EgoState:
    """The egos of B scenes at states [B, 4], projected on their missions, from which
    progress counts.

    place [B]: arc length [m] near which they are, None where it is unknown; agents [B,
    M]: any tensor of the others.
    """
    hint = None if place is None else place[:, None]
    pose = FrenetPose(
        *(
            value[:, 0]
            for value in project(state[:, None, :2], mission.points, hint=hint)
        )
    )
    inside = torch.zeros_like(agents, dtype=torch.bool)
    return EgoState(
        step,
        state,
        action=action,
        pose=pose,
        present=present,
        been_on_road=on_road,
        start_s=pose.s,
        inside=inside,
    )


EGO_STATE = (
    "B:int64",
    "B 4!",
    "B 2!",
    "B",
    "B",
    "B",
    "B:bool",
    "B:bool",
    "B",
    "B M:bool",
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

    def numbers(*values: float) -> Tensor:
        return torch.tensor(values, device=device)

    scales = numbers(FAR, NEAR, 1.0, 1.0, SPEED, SPEED, SPEED, 4.0, 2.5, 1.0, 1.0)[
        :, None
    ]
    probes = torch.cartesian_prod(numbers(*PROBE_X), numbers(*PROBE_Y))
    return ObservationConfig(
        numbers(*LOOK_AHEAD, 0.0), probes, agent=scales, colours=numbers(1, 2, 3)
    )


def observe(
    static: StaticScene, ego: EgoState, agents: Agents, time: Tensor
) -> Observed:
    """The observation of egos at a time [B], the elapsed fraction of the episode."""
    config = observation_config(ego.state.device)
    rotation = rotation_into(ego.state)
    neighbours = neighbours_of(
        ego.state, rotation, size=static.size, half_size=static.half_size, agents=agents
    )
    if torch.compiler.is_compiling():
        ahead, left = config.probes.unbind(1)
        x, y = (
            ego.state[:, k, None]
            + ahead * rotation[:, 0, k, None]
            + left * rotation[:, 1, k, None]
            for k in (0, 1)
        )
        border = off_road_at(x, y, field=static.field, origin=static.origin)
    else:
        probes = torch.baddbmm(
            ego.state[:, None, :2],
            config.probes.expand(len(rotation), -1, -1),
            rotation,
        )
        border = off_road(probes, static.field, origin=static.origin)
    route, limit = route_features(config, static, ego=ego, rotation=rotation)
    near = nearest(static, neighbours)
    blocks = [
        ego_features(static, ego, limit=limit, time=time),
        route,
        light_features(config, static, step=ego.step, s=ego.pose.s),
        (border / 4).clamp(-1, 1),
        agent_features(config, ego, near=near),
        prospects(
            static, ego.state, pose=ego.pose, rotation=rotation, others=others_of(near)
        ),
    ]
    return Observed(
        neighbours, border[:, CENTRE], limit=limit, features=torch.cat(blocks, -1)
    )


@fused(STATIC, EGO_STATE, AGENTS, "B")
def features(
    static: StaticScene, ego: EgoState, agents: Agents, time: Tensor
) -> Tensor:
    """The features [B, OBSERVATION_SIZE] of `observe`, alone."""
    return observe(static, ego, agents=agents, time=time).features


def glance(
    static: StaticScene, ego: EgoState, agents: Agents, time: Tensor
) -> Observed:
    """`observe` without the features: what events and reward need, at a moment at which
    no policy looks."""
    neighbours = neighbours_of(
        ego.state,
        rotation_into(ego.state),
        size=static.size,
        half_size=static.half_size,
        agents=agents,
    )
    beyond = off_road(ego.state[:, None, :2], static.field, origin=static.origin)[:, 0]
    nothing = ego.state[:, :0]
    return Observed(
        neighbours, beyond, limit=limit_at(static.mission, ego.pose.s), features=nothing
    )


def ego_features(
    static: StaticScene, ego: EgoState, limit: Tensor, time: Tensor
) -> Tensor:
    """[B, 11]: speed, last action (2), offset and heading to the mission (3), speed
    limit, distance to the map's end, size (2), elapsed fraction of the episode."""
    state = ego.state
    action = ego.action
    pose = ego.pose
    size = static.size
    turned = state[:, 2] - pose.heading
    left = ((static.mission.end - pose.s) / 100).clamp(0, 1)
    limit = read_as(limit, state[:, 3])
    features = [
        state[:, 3] / SPEED,
        action[:, 0] / 4,
        action[:, 1],
        (pose.d / 3).clamp(-2, 2),
        turned.sin(),
    ]
    features += [
        turned.cos(),
        limit / SPEED,
        left,
        size[:, 0] / 5,
        size[:, 1] / 2,
        time,
    ]
    return torch.stack(features, -1)


def read_as(limit: Tensor, speed: Tensor) -> Tensor:
    """Speed limits [...] m/s as a policy reads them: UNLIMITED where unknown (0), or
    the ego's speed, if higher."""
    return torch.where(limit > 0, limit, speed.clamp(min=UNLIMITED))


def route_features(
    config: ObservationConfig, static: StaticScene, ego: EgoState, rotation: Tensor
) -> tuple[Tensor, Tensor]:
    """[B, 12 * 5]: mission points ahead in the ego's frame (2), relative heading,
    curvature, speed limit; and the speed limit at the ego [B]."""
    x, y, heading, curvature, limit = look_along(
        static, ego.pose.s[:, None] + config.ahead
    )
    x, y = seen_from(ego.state, rotation, x=x, y=y)
    turned = (heading - ego.state[:, 2:3]).sin()
    seen = read_as(limit, ego.state[:, 3:])
    features = torch.stack(
        [x / FAR, y / NEAR, turned, (10 * curvature).clamp(-2, 2), seen / SPEED], -1
    )
    return features[:, :-1].clamp(-5, 5).flatten(1), limit[:, -1]


def light_features(
    config: ObservationConfig, static: StaticScene, step: Tensor, s: Tensor
) -> Tensor:
    """[B, 2 * 4]: the mission's lights red, yellow, green (one-hot while ahead) and
    nearness (1 at the line, 0 far)."""
    light = static.mission.light
    ahead = static.mission.light_s - s[:, None]
    seen = (light >= 0) & (ahead > -2)
    state = static.lights[static.row[:, 0], step.clamp(0, static.lights.shape[1] - 1)]
    colours = state[..., None] == config.colours
    near = (-ahead.clamp(min=0) / 30).exp()
    return (
        torch.cat([colours.to(s.dtype), near[..., None]], -1) * seen[..., None]
    ).flatten(1)


def nearest(static: StaticScene, others: Neighbours) -> Tensor:
    """Table [B, 12, K] of the K <= NEAREST nearest agents: position (2), direction (2),
    half sizes (2), gap, speed, acceleration, turn rate, whether it is a vehicle,
    presence."""
    states, present, accel, turn_rate = others.agents
    apart = others.position.square().sum(1).masked_fill(~present, torch.inf)
    scalars = others.gap, states[..., 3], accel, turn_rate, static.vehicle, present
    columns = [
        others.position,
        others.direction,
        static.half_size,
        *(value[:, None] for value in scalars),
    ]
    if (
        torch.compiler.is_compiling()
    ):  # for any number of agents; of none but the nearest more than its place
        apart = torch.nn.functional.pad(apart, (0, NEAREST), value=torch.inf)
        index = apart.topk(NEAREST, dim=1, largest=False).indices[:, None]
        columns = [
            torch.nn.functional.pad(value.to(apart.dtype), (0, NEAREST))
            for value in columns
        ]
        return torch.cat(
            [
                value.gather(2, index.expand(-1, value.shape[1], -1))
                for value in columns
            ],
            1,
        )
    index = apart.topk(min(NEAREST, apart.shape[1]), dim=1, largest=False).indices[
        :, None
    ]
    table = torch.cat(columns, 1)
    return table.gather(2, index.expand(-1, table.shape[1], -1))


def agent_features(config: ObservationConfig, ego: EgoState, near: Tensor) -> Tensor:
    """[B, 12 * PER_AGENT] of the table `nearest`: presence, relative pose (4) and
    velocity (2), speed, acceleration, size (2), whether it is a vehicle, gap, time and
    distance of the closest approach at constant velocities, and turn rate; absent
    agents are zeros."""
    local, direction, half, gap, speed, accel, turn_rate, vehicle, present = near.split(
        COLUMNS, 1
    )
    velocity = speed * direction - torch.nn.functional.pad(
        ego.state[:, 3:, None], (0, 0, 0, 1)
    )
    time = (
        -(local * velocity).sum(1, True) / (velocity.square().sum(1, True) + 1e-3)
    ).clamp(0, 8)
    miss = (local + velocity * time).norm(dim=1, keepdim=True)
    scaled = (
        torch.cat([local, direction, velocity, speed, accel, half, vehicle], 1)
        / config.agent
    )
    decay = torch.cat([-time / 2, -miss / 5], 1).exp()
    turning = (turn_rate / TURNING).clamp(-5, 5)
    features = (
        torch.cat(
            [present, scaled.clamp(-5, 5), (gap / NEAR).clamp(-1, 2), decay, turning], 1
        )
        * present
    )
    features = features.transpose(1, 2).flatten(1)
    return torch.nn.functional.pad(features, (0, PER_AGENT * (NEAREST - near.shape[2])))


def others_of(near: Tensor) -> Others:
    """The LOOKED_AT nearest agents of the table `nearest`."""
    near = near[..., :LOOKED_AT]
    local, direction, half, _, speed, accel, turn_rate, _, present = (
        x.squeeze(1) for x in near.split(COLUMNS, 1)
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
    `block.number.quantity` (docs/observation.md)."""
    manoeuvres = [
        f"{accel:+g}.{offset:+g}" for accel in ACCELERATIONS for offset in OFFSETS
    ]
    blocks = [
        _named("ego", EGO),
        *(_named(f"route.{k}", POINT) for k in range(len(LOOK_AHEAD))),
        *(_named(f"light.{k}", LIGHT) for k in range(2)),
        [
            Entry(f"border.{x:+g}.{y:+g}", "m", scale=4.0)
            for x in PROBE_X
            for y in PROBE_Y
        ],
        *(_named(f"agent.{k}", AGENT) for k in range(NEAREST)),
        [Entry(f"manoeuvre.{name}.gap", "m", scale=WIDEST) for name in manoeuvres],
        [
            Entry(f"manoeuvre.{name}.contact", "s", scale=TIMES[-1] + TIMES[0])
            for name in manoeuvres
        ],
    ]
    found = [entry for block in blocks for entry in block]
    assert len(found) == OBSERVATION_SIZE
    return found


def _named(block: str, entries: tuple[Entry, ...]) -> list[Entry]:
    return [entry._replace(name=f"{block}.{entry.name}") for entry in entries]


# quantities that change sign
SIDED = (
    "yaw_rate",
    "offset",
    "heading_sin",
    "curvature",
    "y",
    "velocity_y",
    "turn_rate",
)


@cache
def _mirror(device: torch.device) -> tuple[Tensor, Tensor]:
    """Whose number [D] each number becomes, and its sign [D]."""
    names = [entry.name for entry in observation_layout()]
    source = torch.arange(len(names))
    for start, end, shape in (
        ("border.", "", (len(PROBE_X), len(PROBE_Y))),
        ("manoeuvre.", ".gap", (len(ACCELERATIONS), len(OFFSETS))),
        ("manoeuvre.", ".contact", (len(ACCELERATIONS), len(OFFSETS))),
    ):
        block = [
            index
            for index, name in enumerate(names)
            if name.startswith(start) and name.endswith(end)
        ]
        source[block] = torch.tensor(block).reshape(shape).flip(1).flatten()
    sign = torch.tensor(
        [-1.0 if name.rsplit(".", 1)[1] in SIDED else 1.0 for name in names]
    )
    return source.to(device), sign.to(device)


def mirrored(observation: Tensor) -> Tensor:
    """The observations [..., D] of the mirrored scenes, y to -y; twice gives the
    original."""
    source, sign = _mirror(observation.device)
    return observation[..., source] * sign
