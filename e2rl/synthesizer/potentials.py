"""The potentials of the control, eq. (potential_decomp): V_feas of every vehicle, V_adv of the coalition along its
chain.

Both act on decoded states [B, V, H', 4] (x, y [m], heading [rad], speed [m/s]) at every stride-th step and are
returned per vehicle, [B, V]. Everybody else is detached in a vehicle's own term: the ego is a black box, targets are
not drawn to their pursuers, and the gradient of row i is that of V_i alone. Gradients are finite everywhere.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.errors import InputError
from e2rl.scene.boxes import to_frame
from e2rl.scene.recording import DT
from e2rl.scene.route import interpolate, project
from e2rl.sim.drivable import off_road
from e2rl.sim.dynamics import wrap

LENGTH = 2.0  # m: distances of V_adv are in this unit, so that eta of 0 to 3 is a usable dial
CLOSING = 10.0  # m/s: unit of the impact speed


@dataclass(frozen=True)
class PotentialSettings:
    """Weights and shapes of the terms; conf/synthesizer/e2.yaml explains each."""

    stride: int = 5
    off_road: float = 1.0
    off_road_margin: float = 0.3
    lateral: float = 0.1
    lateral_bound: float = 1.0
    pair: float = 1.0
    pair_margin: float = 0.3
    pair_disks: int = 3
    neighbours: int = 6
    accel: float = 0.5
    min_accel: float = -3.5
    max_accel: float = 2.0
    max_lateral_accel: float = 4.0
    jerk: float = 1.0
    max_jerk: float = 2.0
    wrong_way: float = 0.1
    distance: float = 1.0
    distance_kind: str = "centre"
    narrow: float = 0.5
    wide: float = 3.0
    ttc: float = 0.5
    ttc_time: float = 1.0
    ttc_miss: float = 1.0
    impact_speed: float = 0.1

    def __post_init__(self):
        if self.distance_kind not in ("centre", "box"):
            raise InputError(f"synthesizer.potentials.distance_kind is {self.distance_kind!r}; choose centre or box")
        if min(self.narrow, self.wide, self.ttc_time, self.ttc_miss) <= 0:
            raise InputError("synthesizer.potentials: narrow, wide, ttc_time and ttc_miss must be positive")
        if self.stride < 1 or self.pair_disks < 2 or self.neighbours < 1:
            raise InputError("synthesizer.potentials needs stride >= 1, pair_disks >= 2 and neighbours >= 1")


@dataclass(frozen=True)
class PotentialContext:
    """What stays fixed while a plan is denoised.

    scene [B]; start [B, V, 4] and accel [B, V]: now; valid [B, V]; route [B, V, P, 2]: the route each vehicle follows,
    on_route [B, V]: it has one; ego_plan [B, H, 4]; target [B, V] int64: of the skeleton, -1 outside the coalition.
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
    def place(self) -> tuple[Tensor, Tensor]:
        """Arc length and offset [B, V] of the start on the route."""
        s, d, _ = project(self.start[:, :, None, :2], self.route)
        return s[..., 0], d[..., 0]

    @cached_property
    def beyond(self) -> Tensor:
        """Metres [B, V] off the drivable area at the start."""
        return off_road(self.start[..., :2], self.scene["field"], self.scene["field_origin"])


def annealed_temperature(noise_level: Tensor | float, settings: PotentialSettings) -> Tensor:
    """Soft-min temperature [m] at a noise level in [0, 1]: `wide` in pure noise, `narrow` at the end, geometric
    between.

    A wide soft-min is felt by adversaries that are still far away; a narrow one picks the moment of contact.
    """
    level = torch.as_tensor(noise_level, dtype=torch.float32).clamp(0, 1)
    return settings.narrow * (settings.wide / settings.narrow) ** level


def _length(vector: Tensor) -> Tensor:
    """Length [...] of vector [..., 2] with a finite gradient (0) at 0."""
    return (vector.square().sum(-1) + 1e-6).sqrt() - 1e-3


def _velocity(states: Tensor) -> Tensor:
    return states[..., 3:] * torch.stack([states[..., 2].cos(), states[..., 2].sin()], -1)


def box_gap(states: Tensor, size: Tensor, other: Tensor, other_size: Tensor, disks: int) -> Tensor:
    """Signed gap [...] [m] between a vehicle as `disks` disks and another as an oriented box; < 0 where they overlap.

    states, other [..., 4], sizes [..., 2], leading dims broadcast. The disks (as wide as the vehicle) lie along its
    centreline from bumper to bumper; the gap is that of the nearest one.
    """
    along = torch.linspace(-0.5, 0.5, disks, device=states.device)
    reach = (size[..., :1] - size[..., 1:]).clamp(min=0) * along
    forward = torch.stack([states[..., 2].cos(), states[..., 2].sin()], -1)
    centres = states[..., None, :2] + reach[..., None] * forward[..., None, :]
    local = to_frame(centres, other[..., None, :]).abs() - other_size[..., None, :] / 2
    outside = _length(local.clamp(min=0))
    return (outside + local.amax(-1).clamp(max=0)).amin(-1) - size[..., 1] / 2


def _neighbours(states: Tensor, context: PotentialContext, size: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The vehicles that come nearest to each, index and mask [B, V, Q]; adversary and target are none to each other."""
    xy = states[..., :2].detach().transpose(1, 2)
    reach = size.norm(dim=-1) / 2
    gap = torch.cdist(xy, xy).amin(1) - reach[:, :, None] - reach[:, None]
    chases = context.target[..., None] == torch.arange(gap.shape[-1], device=gap.device)
    both = context.valid[:, :, None] & context.valid[:, None]
    itself = torch.eye(gap.shape[-1], dtype=torch.bool, device=gap.device)
    gap = gap.masked_fill(~both | chases | chases.transpose(1, 2) | itself, torch.inf)
    near = gap < 5.0
    count = min(count, max(int(near.sum(-1).max()), 1))  # who is farther costs nothing
    near, index = gap.topk(count, largest=False)
    return index, near < 5.0


def _overlap_term(states: Tensor, context: PotentialContext, settings: PotentialSettings) -> Tensor:
    """Mean over steps, sum over neighbours of the squared shortfall of the gap [m^2]; pairs too near now may stay
    so.
    """
    size = context.scene["size"][:, : states.shape[1]]
    index, near = _neighbours(states, context, size, settings.neighbours)
    scene, own, rank = near.nonzero(as_tuple=True)  # most of the nearest are too far to cost anything
    mine, them = (scene, own), (scene, index[scene, own, rank])
    gap = box_gap(states[mine], size[mine][:, None], states.detach()[them], size[them][:, None], settings.pair_disks)
    now = box_gap(context.start[mine], size[mine], context.start[them], size[them], settings.pair_disks)
    missing = (now.clamp(max=settings.pair_margin)[:, None] - gap).clamp(min=0).square().mean(-1)
    return torch.zeros_like(states[..., 0, 0]).index_put(mine, missing, accumulate=True)


def _road_terms(states: Tensor, context: PotentialContext, settings: PotentialSettings) -> Tensor:
    """Weighted off-road, lateral and wrong-way terms; no worse than at the start costs nothing."""
    scene = context.scene
    beyond = off_road(states[..., :2], scene["field"], scene["field_origin"])
    allowed = context.beyond.clamp(min=-settings.off_road_margin)[..., None]
    leaving = (beyond - allowed).clamp(0, 5).square().mean(-1)
    s, d = context.place
    with torch.no_grad():
        track = torch.cat([context.start[:, :, None, :2], states[..., :2]], 2)
        hint = s[..., None] + track.diff(dim=2).norm(dim=-1).cumsum(-1)
        xy, heading, _ = interpolate(context.route, project(track[:, :, 1:], context.route, hint, 10.0)[0])
    cos, sin = heading.cos(), heading.sin()
    delta = states[..., :2] - xy
    aside = (cos * delta[..., 1] - sin * delta[..., 0]).abs()
    bound = d[..., None].abs().clamp(min=settings.lateral_bound)
    drifting = (aside - bound).clamp(0, 5).square().mean(-1)
    against = ((-(states[..., 2] - heading).cos()).clamp(min=0) * states[..., 3]).mean(-1)
    on_route = settings.lateral * drifting + settings.wrong_way * against
    return settings.off_road * leaving + on_route * context.on_route


def _motion_terms(states: Tensor, context: PotentialContext, settings: PotentialSettings) -> Tensor:
    """Weighted excess of longitudinal and lateral acceleration [m/s^2]^2 and of jerk [m/s^3]^2 over their bounds."""
    step = settings.stride * DT
    track = torch.cat([context.start[:, :, None], states], 2)
    accel = torch.diff(track[..., 3], dim=-1) / step
    turn = wrap(torch.diff(track[..., 2], dim=-1)) / step
    sideways = turn.abs() * track[..., 1:, 3]
    excess = (accel - settings.max_accel).clamp(min=0).square() + (settings.min_accel - accel).clamp(min=0).square()
    excess = excess + (sideways - settings.max_lateral_accel).clamp(min=0).square()
    jerk = torch.diff(torch.cat([context.accel[..., None], accel], -1), dim=-1) / step
    rough = (jerk.abs() - settings.max_jerk).clamp(min=0).square()
    return settings.accel * excess.mean(-1) + settings.jerk * rough.mean(-1)


def sampled_steps(settings: PotentialSettings) -> slice:
    """The steps of a plan that the potentials look at."""
    return slice(settings.stride - 1, None, settings.stride)


def _with_ego(states: Tensor, context: PotentialContext, settings: PotentialSettings) -> Tensor:
    """Sampled states [B, V, H', 4], row 0 replaced by the detached ego plan."""
    ego = context.ego_plan[:, None, sampled_steps(settings)].detach()
    return torch.cat([ego[:, :, : states.shape[2]], states[:, 1:]], 1)


def feasibility_potential(states: Tensor, context: PotentialContext, settings: PotentialSettings) -> Tensor:
    """V_feas [B, V] of decoded states [B, V, H', 4] at `sampled_steps`: off-road, offset from the route, overlap
    with others (except between an adversary and its target), acceleration, jerk, wrong way (design.md 7.3). 0 for the
    ego and for absent vehicles.
    """
    states = _with_ego(states, context, settings)
    value = (
        _road_terms(states, context, settings)
        + _motion_terms(states, context, settings)
        + settings.pair * _overlap_term(states, context, settings)
    )
    counted = context.valid.clone()
    counted[:, 0] = False
    return torch.where(counted, value, 0.0)


def ttc_cost(offset: Tensor, closing: Tensor, time_scale: float = 1.0, miss_scale: float = 1.0) -> Tensor:
    """TTC cost [...] in [0, 1] of relative position offset [..., 2] and velocity closing [..., 2] at constant velocity.

    exp(-t^2 / (2 time_scale^2) - d^2 / (2 miss_scale^2)) at the closest point of approach (reference section 8.5, fixed
    form): near 0 for a stopped pair, 1 on contact at the centres.
    """
    time = (-(offset * closing).sum(-1) / (closing.square().sum(-1) + 1e-6)).clamp(min=0)
    miss = offset + closing * time[..., None]
    return torch.exp(-0.5 * (time / time_scale) ** 2 - 0.5 * miss.square().sum(-1) / miss_scale**2)


def adversarial_potential(
    states: Tensor, context: PotentialContext, settings: PotentialSettings, temperature: Tensor | float | None = None
) -> Tensor:
    """V_adv [B, V] of decoded states [B, V, H', 4] at `sampled_steps`, along the chain: low where a vehicle
    meets its own target.

    Soft minimum over time of the distance to the target (in units of 2 m; temperature in m, default `narrow`), TTC cost
    and closing speed, all against the detached target. 0 outside the coalition.
    """
    states = _with_ego(states, context, settings)
    index = context.target.clamp(min=0)
    size = context.scene["size"][:, : states.shape[1]]
    target = states.detach().gather(1, index[..., None, None].expand_as(states))
    offset = target[..., :2] - states[..., :2]
    if settings.distance_kind == "box":
        other = size.gather(1, index[..., None].expand_as(size))
        apart = box_gap(states, size[:, :, None], target, other[:, :, None], settings.pair_disks).clamp(min=0)
    else:
        apart = _length(offset)
    heat = settings.narrow if temperature is None else temperature
    nearest = -heat * (torch.logsumexp(-apart / heat, -1) - math.log(apart.shape[-1]))
    closing = _velocity(target) - _velocity(states)
    cost = ttc_cost(offset, closing, settings.ttc_time, settings.ttc_miss).amax(-1)
    moment = torch.softmax(-apart.detach() / heat, -1)
    bearing = offset.detach() / (_length(offset.detach()) + 0.1)[..., None]
    impact = (-(closing * bearing).sum(-1).clamp(-2 * CLOSING, 2 * CLOSING) * moment).sum(-1) / CLOSING
    value = settings.distance * nearest / LENGTH + settings.ttc * (1 - cost) - settings.impact_speed * impact
    acts = context.valid & (context.target >= 0) & context.valid.gather(1, index)
    acts[:, 0] = False
    return torch.where(acts, value, 0.0)
