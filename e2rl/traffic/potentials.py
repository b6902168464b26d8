"""The potentials of the control, eq. (potential_decomp): V_feas of every vehicle, V_adv
of the coalition.

Both take decoded states [B, V, H', 4] (x, y [m], heading [rad], speed [m/s]) at
SAMPLED_STEPS of a plan and return one value per vehicle, [B, V]. In a vehicle's own
term all others are detached: the ego is a black box, targets are not drawn to their
pursuers, and the gradient of row i is that of V_i alone. Gradients are finite
everywhere.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.metrics.geometry import velocity
from e2rl.run.config import configured, setting
from e2rl.scenes.boxes import to_frame, unit_vectors
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT
from e2rl.scenes.route import interpolate, project
from e2rl.sim.dynamics import closest_approach_cost, wrap

STRIDE = 5  # steps between the states of a plan that the potentials look at
SAMPLED_STEPS = slice(STRIDE - 1, None, STRIDE)
LENGTH = 2.0  # m: unit of distances in V_adv, so that eta of 0 to 3 is a usable dial
CLOSING = 10.0  # m/s: unit of the closing speed in V_adv
DISKS = 3  # that stand for a vehicle against another's box
NEIGHBOURS = 6  # nearest vehicles looked at
NEAR = 5.0  # m: pairs that stay farther apart cost nothing
MAX_EXCESS = 5.0  # m: excesses of offset and of distance off the road are cut there
OFF_ROAD_MARGIN = 0.3  # m inside the border of the drivable area where its term begins
LATERAL_BOUND = 1.0  # m of offset that cost nothing
PAIR_MARGIN = 0.3  # m of gap that is wanted
MIN_ACCEL = -3.5  # m/s^2: what is beyond these bounds costs
MAX_ACCEL = 2.0  # m/s^2
MAX_LATERAL_ACCEL = 4.0  # m/s^2
MAX_JERK = 2.0  # m/s^3


@configured("synthesizer/e2_paper", "potentials")
@dataclass(frozen=True)
class PotentialSettings:
    """The potentials, with weights of their terms and temperatures [m];
    conf/synthesizer/e2_paper.yaml explains each.

    A subclass may have another objective, `adversarial`, or other bounds,
    `feasibility`: named by `potentials._target_` of a synthesizer.
    """

    off_road: float = setting()
    lateral: float = setting()
    pair: float = setting()
    accel: float = setting()
    jerk: float = setting()
    wrong_way: float = setting()
    distance: float = setting()
    narrow: float = setting(low=1e-3)
    wide: float = setting(low=1e-3)
    ttc: float = setting()
    impact_speed: float = setting()

    def adversarial(
        self,
        states: Tensor,
        context: "PotentialContext",
        temperature: Tensor | float,
    ) -> Tensor:
        """Returns V_adv [B, V], which adversaries lower: see `adversarial_potential`."""
        return adversarial_potential(
            states,
            context,
            settings=self,
            temperature=temperature,
        )

    def feasibility(self, states: Tensor, context: "PotentialContext") -> Tensor:
        """Returns V_feas [B, V], which all vehicles lower: see `feasibility_potential`."""
        return feasibility_potential(states, context, settings=self)


@dataclass(frozen=True)
class PotentialContext:
    """What stays fixed while a plan is denoised.

    scene [B]; start [B, V, 4] and accel [B, V]: present states and accelerations; valid
    [B, V]; route [B, V, P, 2]: the path each vehicle follows, on_route [B, V]: it has
    one; ego_plan [B, H, 4]; target [B, V] int64: the vehicle that each of the coalition
    acts on, -1 for all others.
    """

    scene: TensorDictBase
    start: Tensor
    accel: Tensor
    valid: Tensor
    route: Tensor
    on_route: Tensor
    ego_plan: Tensor
    target: Tensor

    @cached_property
    def start_frenet(self) -> tuple[Tensor, Tensor]:
        """Arc length and lateral offset [B, V] of the present states on the route."""
        s, d, _ = project(self.start[:, :, None, :2], self.route)
        return s[..., 0], d[..., 0]

    @cached_property
    def start_off_road(self) -> Tensor:
        """Metres [B, V] off the drivable area at present."""
        return off_road(
            self.start[..., :2],
            self.scene["field"],
            origin=self.scene["field_origin"],
        )


def annealed_temperature(
    noise_level: Tensor | float, settings: PotentialSettings
) -> Tensor:
    """Returns the soft-min temperature [m] at a noise level in [0, 1]: geometric from
    `narrow` at 0 to `wide` at 1.

    A wide soft-min is felt by adversaries that are still far away; a narrow one picks
    the moment of contact.
    """
    level = torch.as_tensor(noise_level, dtype=torch.float32).clamp(0, 1)
    return settings.narrow * (settings.wide / settings.narrow) ** level


def _length(vector: Tensor) -> Tensor:
    """Length [...] of vector [..., 2] with a finite gradient (0) at 0."""
    return (vector.square().sum(-1) + 1e-6).sqrt() - 1e-3


def box_gap(
    states: Tensor,
    size: Tensor,
    other: Tensor,
    other_size: Tensor,
    disks: int = DISKS,
) -> Tensor:
    """Returns the signed gap [...] m between a vehicle as disks and another as an
    oriented box, < 0 where they overlap. Leading dimensions are broadcast.

    Args:
        states: [..., 4], the vehicle's.
        size: [..., 2] m.
        other: [..., 4].
        other_size: [..., 2] m.
        disks: as wide as the vehicle, along its centreline from bumper to bumper; the
            gap is that of the nearest one.
    """
    along = torch.linspace(-0.5, 0.5, disks, device=states.device)
    shift = (size[..., :1] - size[..., 1:]).clamp(min=0) * along
    centres = (
        states[..., None, :2]
        + shift[..., None] * unit_vectors(states[..., 2])[..., None, :]
    )
    local = to_frame(centres, other[..., None, :]).abs() - other_size[..., None, :] / 2
    outside = _length(local.clamp(min=0))
    return (outside + local.amax(-1).clamp(max=0)).amin(-1) - size[..., 1] / 2


def _neighbours(
    states: Tensor,
    context: PotentialContext,
    size: Tensor,
) -> tuple[Tensor, Tensor]:
    """Index and mask [B, V, Q] of the vehicles that come nearest to each; adversary and
    target are no neighbours."""
    xy = states[..., :2].detach().transpose(1, 2)
    radius = size.norm(dim=-1) / 2
    gap = torch.cdist(xy, xy).amin(1) - radius[:, :, None] - radius[:, None]
    pursues = context.target[..., None] == torch.arange(
        gap.shape[-1], device=gap.device
    )
    both = context.valid[:, :, None] & context.valid[:, None]
    itself = torch.eye(gap.shape[-1], dtype=torch.bool, device=gap.device)
    gap = gap.masked_fill(~both | pursues | pursues.transpose(1, 2) | itself, torch.inf)
    count = min(NEIGHBOURS, max(int((gap < NEAR).sum(-1).max()), 1))
    gap, index = gap.topk(count, largest=False)
    return index, gap < NEAR


def _overlap_term(states: Tensor, context: PotentialContext) -> Tensor:
    """Squared shortfall of the gap to neighbours [m^2], at most the present gap; mean
    over steps, their sum [B, V]."""
    size = context.scene["size"][:, : states.shape[1]]
    index, near = _neighbours(states, context, size=size)
    # Most of the nearest are too far to cost anything.
    scene, vehicle, rank = near.nonzero(as_tuple=True)
    mine = (scene, vehicle)
    them = (scene, index[scene, vehicle, rank])
    gap = box_gap(
        states[mine],
        size[mine][:, None],
        other=states.detach()[them],
        other_size=size[them][:, None],
    )
    present = box_gap(
        context.start[mine],
        size[mine],
        other=context.start[them],
        other_size=size[them],
    )
    missing = (
        (present.clamp(max=PAIR_MARGIN)[:, None] - gap).clamp(min=0).square().mean(-1)
    )
    return torch.zeros_like(states[..., 0, 0]).index_put(mine, missing, accumulate=True)


def _road_terms(
    states: Tensor,
    context: PotentialContext,
    settings: PotentialSettings,
) -> Tensor:
    """Weighted off-road, lateral and wrong-way terms [B, V]; what is no worse than at
    present costs nothing."""
    scene = context.scene
    beyond = off_road(states[..., :2], scene["field"], origin=scene["field_origin"])
    allowed = context.start_off_road.clamp(min=-OFF_ROAD_MARGIN)[..., None]
    off_road_term = (beyond - allowed).clamp(0, MAX_EXCESS).square().mean(-1)
    s, d = context.start_frenet
    with torch.no_grad():
        track = torch.cat([context.start[:, :, None, :2], states[..., :2]], 2)
        hint = s[..., None] + track.diff(dim=2).norm(dim=-1).cumsum(-1)
        xy, heading, _ = interpolate(
            context.route,
            project(track[:, :, 1:], context.route, hint=hint, window=10.0)[0],
        )
    cos = heading.cos()
    sin = heading.sin()
    delta = states[..., :2] - xy
    offset = (cos * delta[..., 1] - sin * delta[..., 0]).abs()
    bound = d[..., None].abs().clamp(min=LATERAL_BOUND)
    lateral_term = (offset - bound).clamp(0, MAX_EXCESS).square().mean(-1)
    wrong_way_term = (
        (-(states[..., 2] - heading).cos()).clamp(min=0) * states[..., 3]
    ).mean(-1)
    on_route = settings.lateral * lateral_term + settings.wrong_way * wrong_way_term
    return settings.off_road * off_road_term + on_route * context.on_route


def _motion_terms(
    states: Tensor,
    context: PotentialContext,
    settings: PotentialSettings,
) -> Tensor:
    """Weighted squared excess of accelerations [m/s^2] and jerk [m/s^3] over their
    bounds [B, V]."""
    step = STRIDE * DT
    track = torch.cat([context.start[:, :, None], states], 2)
    accel = torch.diff(track[..., 3], dim=-1) / step
    yaw_rate = wrap(torch.diff(track[..., 2], dim=-1)) / step
    lateral = yaw_rate.abs() * track[..., 1:, 3]
    excess = (accel - MAX_ACCEL).clamp(min=0).square() + (MIN_ACCEL - accel).clamp(
        min=0
    ).square()
    excess = excess + (lateral - MAX_LATERAL_ACCEL).clamp(min=0).square()
    jerk = torch.diff(torch.cat([context.accel[..., None], accel], -1), dim=-1) / step
    rough = (jerk.abs() - MAX_JERK).clamp(min=0).square()
    return settings.accel * excess.mean(-1) + settings.jerk * rough.mean(-1)


def with_ego(states: Tensor, context: PotentialContext) -> Tensor:
    """Returns sampled states [B, V, H', 4] with the ego's detached plan in row 0."""
    ego = context.ego_plan[:, None, SAMPLED_STEPS].detach()
    return torch.cat([ego[:, :, : states.shape[2]], states[:, 1:]], 1)


def feasibility_potential(
    states: Tensor,
    context: PotentialContext,
    settings: PotentialSettings,
) -> Tensor:
    """Returns V_feas [B, V] of decoded states [B, V, H', 4] at SAMPLED_STEPS; 0 for the
    ego and for absent vehicles.

    Terms: off-road, lateral offset, overlap with others (except between an adversary
    and its target), acceleration, jerk, wrong way.
    """
    states = with_ego(states, context)
    road = _road_terms(states, context, settings=settings)
    motion = _motion_terms(states, context, settings=settings)
    value = road + motion + settings.pair * _overlap_term(states, context)
    counted = context.valid.clone()
    counted[:, 0] = False
    return torch.where(counted, value, 0.0)


def adversarial_potential(
    states: Tensor,
    context: PotentialContext,
    settings: PotentialSettings,
    temperature: Tensor | float | None = None,
) -> Tensor:
    """Returns V_adv [B, V] of decoded states [B, V, H', 4] at SAMPLED_STEPS: low where
    a vehicle meets its own target.

    Soft minimum over time of the distance between the centres, TTC cost and closing
    speed, all against the detached target. 0 outside the coalition.

    Args:
        states: [B, V, H', 4].
        context: what stays fixed while a plan is denoised.
        settings: weights.
        temperature: m, of the soft minimum (None: `narrow`).
    """
    states = with_ego(states, context)
    index = context.target.clamp(min=0)
    target = states.detach().gather(1, index[..., None, None].expand_as(states))
    offset = target[..., :2] - states[..., :2]
    closing = velocity(target) - velocity(states)
    distance = _length(offset)
    temperature = settings.narrow if temperature is None else temperature
    nearest = -temperature * (
        torch.logsumexp(-distance / temperature, -1) - math.log(distance.shape[-1])
    )
    cost = closest_approach_cost(offset, closing).amax(-1)
    moment = torch.softmax(-distance.detach() / temperature, -1)
    bearing = offset.detach() / (_length(offset.detach()) + 0.1)[..., None]
    impact = (
        -(closing * bearing).sum(-1).clamp(-2 * CLOSING, 2 * CLOSING) * moment
    ).sum(-1) / CLOSING
    value = (
        settings.distance * nearest / LENGTH
        + settings.ttc * (1 - cost)
        - settings.impact_speed * impact
    )
    acts = context.valid & (context.target >= 0) & context.valid.gather(1, index)
    acts[:, 0] = False
    return torch.where(acts, value, 0.0)
