"""A route follower that reads only the observation: the learned ego starts from it and
corrects it.

Steering is pure pursuit of the mission. The acceleration is the minimum over IDM behind
every agent in the corridor, IDM behind stop lines that bind, and the speed caps by
limits and curves. Pure functions of e2rl.sim.observation.

The network of the learned ego: every nearby agent goes through the same layers, and the
largest of each unit over the agents joins the rest of the scene (Qi et al., PointNet,
2017; its effect: docs/notes/training.md).
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from e2rl.run.fused import fused, is_on
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

PURSUIT_TIME, PURSUIT_MIN, PURSUIT_MAX = (
    1.5,
    6.0,
    30.0,
)  # s, m, m: look-ahead of the pursuit
ACCELERATION, BRAKING, HARDEST_BRAKING = 1.5, 2.5, 7.0  # m/s^2
HEADWAY, STANDSTILL_GAP, EXPONENT = 1.2, 3.0, 4.0  # s, m
DRIVER = IDMParameters(
    HEADWAY,
    STANDSTILL_GAP,
    acceleration=ACCELERATION,
    braking=BRAKING,
    exponent=EXPONENT,
)
COOLNESS = 0.99  # of the ACC model: 0 is IDM
LATERAL = 2.5  # m/s^2 in curves
REACTION = 0.5  # s in which a speed cap is met
LINE_GAP = 1.0  # m kept to a stop line
OWN_WAY = 0.7  # least cosine between the headings of the path and of a vehicle that drives the ego's way
UNCAPPED = 1e3  # m/s


def follow(observation: Tensor) -> Tensor:
    """[..., 4] at observation [..., D]: the action (m/s^2, rad/s); the bound, an
    acceleration (m/s^2); the room in m.

    The bound is what IDM allows behind whoever is ahead and drives the ego's way, or is
    no vehicle; inf without one. The room is the least gap that going on with -1 or 1
    m/s^2 leaves within the observation's manoeuvres.
    """
    return reference_rows(observation.reshape(-1, OBSERVATION_SIZE)).view(
        *observation.shape[:-1], 4
    )


@fused(f"B {OBSERVATION_SIZE}")
def reference_rows(observation: Tensor) -> Tensor:
    """`follow` [B, 4] at observations [B, D]."""
    ego = observation[..., EGO]
    route = observation[..., ROUTE].unflatten(-1, (len(LOOK_AHEAD), 5))
    speed = ego[..., 0] * SPEED
    path = torch.stack([route[..., 0] * FAR, route[..., 1] * NEAR], -1)
    desired = (ego[..., 6] * SPEED).clamp(min=1.0)
    *leaders, own_way = _leaders(observation, path)
    wanted = _following(speed[..., None], desired[..., None], *leaders).amin(-1)
    least = (-speed / REACTION).clamp(
        min=-HARDEST_BRAKING
    )  # no braking at standstill, as in recordings
    accel = torch.maximum(
        torch.minimum(wanted, _capped(route, speed)).clamp(max=ACCELERATION), least
    )
    behind = _following(
        speed[..., None], torch.full_like(desired, UNCAPPED)[..., None], *leaders
    )
    bound = torch.maximum(torch.where(own_way, behind, torch.inf).amin(-1), least)
    room = observation[..., ROOMS].unflatten(-1, (len(ACCELERATIONS), len(OFFSETS)))[
        ..., MILD, OFFSETS.index(0.0)
    ]
    return torch.stack(
        [accel, speed * _pursuit(path, speed), bound, WIDEST * room.amin(-1)], -1
    )


def _following(
    speed: Tensor, desired: Tensor, gap: Tensor, leading: Tensor, acceleration: Tensor
) -> Tensor:
    """Acceleration [..., K] of the ACC model (Kesting, Treiber and Helbing 2010) behind
    leaders [..., K].

    After a cut-in, IDM brakes fully for a short gap even if the leader pulls away. An
    IDM acceleration below that of the constant-acceleration heuristic, which only
    avoids the crash, is therefore raised towards it.
    """
    own = idm_acceleration(
        speed, desired, gap=gap, leader_speed=leading, driver=DRIVER, improved=True
    )
    space = gap.clamp(0.5, 1e3)
    steady = acceleration.clamp(-HARDEST_BRAKING, ACCELERATION)
    stops_first = leading * (speed - leading) <= -2 * space * steady
    halting = speed**2 * steady / (leading**2 - 2 * space * steady).clamp(min=1e-3)
    closing = steady - (speed - leading).clamp(min=0) ** 2 / (2 * space)
    least = torch.where(stops_first, halting, closing)
    soft = (1 - COOLNESS) * own + COOLNESS * (
        least + BRAKING * ((own - least) / BRAKING).tanh()
    )
    return torch.where((own < least) & gap.isfinite(), soft, own)


def _pursuit(path: Tensor, speed: Tensor) -> Tensor:
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


def _capped(route: Tensor, speed: Tensor) -> Tensor:
    """Acceleration [...] that reaches the speed cap by limits and curves ahead within
    REACTION."""
    ahead = route.new_tensor(LOOK_AHEAD)
    curvature = route[..., 3].abs() / 10
    limit = route[..., 4] * SPEED
    squared = torch.minimum(LATERAL / curvature.clamp(min=1e-3), limit**2)
    allowed = (
        (squared + 2 * BRAKING * (ahead - speed[..., None] * REACTION).clamp(min=0))
        .amin(-1)
        .sqrt()
    )
    return (allowed - speed) / REACTION


def _leaders(
    observation: Tensor, path: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Free gap [..., NEAREST + 2] m along path [..., K, 2], inf for none, speed along
    it and acceleration, of agents and stop lines; and whether the bound of `follow`
    holds behind it."""
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
    gap = (along - aligned.abs() * length - across * width - half_length).masked_fill(
        ~leads, torch.inf
    )
    leading = (agents[..., 7] * SPEED * aligned).clamp(min=0)
    halt = (
        _halts(observation, ego[..., 0] * SPEED)
        - half_length
        - LINE_GAP
        + STANDSTILL_GAP
    )
    still = torch.zeros_like(halt)
    steady = 4 * agents[..., 8] * aligned
    own_way = leads & ((aligned > OWN_WAY) | (agents[..., 11] < 0.5))
    pairs = (
        (gap, halt),
        (leading, still),
        (steady, still),
        (own_way, torch.zeros_like(halt, dtype=torch.bool)),
    )
    gap, leading, steady, own_way = (torch.cat(pair, -1) for pair in pairs)
    return gap, leading, steady, own_way


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
    begun = (length.cumsum(-1) - length)[..., None, :]
    along = (begun + t).gather(-1, index[..., None])[..., 0]
    direction = unit.expand(*t.shape, 2).gather(
        -2, index[..., None, None].expand(*index.shape, 1, 2)
    )[..., 0, :]
    return along, apart, direction


def _halts(observation: Tensor, speed: Tensor) -> Tensor:
    """Metres [..., 2] to the stop lines that bind: red if twice BRAKING halts before
    it, yellow if BRAKING does."""
    light = observation[..., LIGHTS].unflatten(-1, (2, 4))
    ahead = -30 * light[..., 3].clamp(min=1e-4).log()
    needed = speed[..., None] ** 2 / (2 * ahead.clamp(min=1e-3))
    binds = ((light[..., 0] > 0) & (needed < 2 * BRAKING)) | (
        (light[..., 1] > 0) & (needed < BRAKING)
    )
    return ahead.masked_fill(~binds | (ahead <= 0), torch.inf)


class Largest(torch.autograd.Function):
    """`amax(1)` of [B, K, U], whose gradient is a fused function."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        largest = values.amax(1)
        ctx.save_for_backward(values, largest)
        return largest

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return shared(*ctx.saved_tensors, grad)


@fused("B K U", "B U", "B U")
def shared(values: Tensor, largest: Tensor, grad: Tensor) -> Tensor:
    """The gradient of `Largest`: grad [B, U] is shared equally among the values [B, K,
    U] that are the largest."""
    those = torch.where(values == largest[:, None], 1.0, 0.0)
    return those * (grad / those.sum(1))[:, None]


class Trunk(nn.Module):
    """Normalised observations [..., D] -> [..., out]; orthogonal weights, the last
    layer's (`last`) scaled."""

    def __init__(
        self, hidden: Sequence[int], agent_units: int, out: int, last_gain: float
    ) -> None:
        """hidden: units of the layers of the whole scene, one at least; agent_units: of
        both layers of an agent."""
        super().__init__()
        rest, *later = hidden
        sizes = [rest + agent_units, *later]
        self.agent = nn.Sequential(
            *_layer(PER_AGENT, agent_units),
            *_layer(agent_units, agent_units, norm=False),
        )
        self.rest = nn.Sequential(*_layer(OBSERVATION_SIZE - PER_AGENT * NEAREST, rest))
        deeper = zip(sizes[:-1], sizes[1:], strict=True)
        self.joint = nn.Sequential(
            *(module for pair in deeper for module in _layer(*pair))
        )
        self.last = linear(sizes[-1], out, gain=last_gain)

    def forward(self, seen: Tensor) -> Tensor:
        """[..., out]."""
        agents = self.agent(seen[..., AGENTS].unflatten(-1, (NEAREST, PER_AGENT)))
        agents = (
            Largest.apply(agents)
            if is_on() and agents.requires_grad and agents.dim() == 3
            else agents.amax(-2)
        )
        rest = self.rest(
            torch.cat([seen[..., : AGENTS.start], seen[..., AGENTS.stop :]], -1)
        )
        return self.last(self.joint(torch.cat([rest, agents], -1)))


def _layer(fan_in: int, fan_out: int, norm: bool = True) -> list[nn.Module]:
    return [
        linear(fan_in, fan_out, gain=2**0.5),
        *([nn.LayerNorm(fan_out)] if norm else []),
        nn.SiLU(),
    ]


def linear(fan_in: int, fan_out: int, gain: float) -> nn.Linear:
    """A layer of orthogonal weights, scaled by gain, without bias at first."""
    layer = nn.Linear(fan_in, fan_out)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
