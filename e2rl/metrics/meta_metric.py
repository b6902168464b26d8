"""A realism meta-metric in the style of the Waymo Open Sim Agents Challenge (features
and weights of its 2025 edition).

Each vehicle has a histogram of every feature over all its rollouts and steps (steps
taken as independent). With it, likelihood = exp(mean log p(logged value)) over a
scene's vehicles and known steps. Indications (collision, off the road, red light)
happen to a vehicle in a rollout or not: their p is Bernoulli, the fraction of rollouts.
Every bin has additive smoothing SMOOTHING. The meta-metric is the weighted sum of the
likelihoods, in (0, 1].

Features follow the challenge's public description (Montali et al. 2023), alike for
rollouts and logs. Shapes: B rollouts, M tracks (one vehicle of one rollout each), N
agents, T steps; time begins at step 1 of a rollout.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.metrics.catalogue import META_STAGE, STAGES, Metric
from e2rl.scenes.boxes import corners, signed_distance
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT, LIGHT_RED
from e2rl.scenes.route import BEHIND, project_track
from e2rl.sim.dynamics import wrap
from e2rl.sim.mission import light_state_at

TTC_CAP = 5.0  # s
AHEAD_ANGLE = (
    1.31  # rad (75 degrees) between headings beyond which no vehicle follows another
)
BESIDE_ANGLE, BESIDE = (
    0.175,
    0.5,
)  # rad, m: an overlap in width below BESIDE counts for parallel headings only
FAR = 1e3  # m, the distance where there is no other agent
Series = tuple[Tensor, Tensor]  # values and where they are known, each [M, T]


def track_features(
    batch: dict[str, Tensor], rollout: Tensor, agent: Tensor
) -> tuple[dict[str, Series], dict[str, Tensor]]:
    """Histogram features, and indications [M] bool, of the tracks of agents agent [M]
    in rollouts rollout [M].

    batch: states [B, T+1, N, 4], valid [B, T+1, N], size [B, N, 2], field [B, G, G],
    field_origin [B, 2], light_state [B, T+1, L], and of the routes followed
    route_points [B, V, P, 2], route_light, route_light_s [B, V, K].
    """
    states = batch["states"][:, 1:].float()
    valid = batch["valid"][:, 1:]
    size = batch["size"].float()
    others = states[rollout]
    is_track = torch.arange(states.shape[2], device=agent.device) == agent[:, None]
    track = states[rollout, :, agent]
    known = valid[rollout, :, agent]
    own = size[rollout, agent]
    pairs = (track, own, others, size[rollout], valid[rollout] & ~is_track[:, None])
    gap = nearest_object(*pairs)
    vehicles = batch["route_points"].shape[1]
    road = (batch["field"], batch["field_origin"])
    beyond = beyond_road(states[:, :, :vehicles], size[:, :vehicles], *road)[
        rollout, :, agent
    ]
    route, light, light_s = (
        batch[key][rollout, agent]
        for key in ("route_points", "route_light", "route_light_s")
    )
    red = runs_red_light(
        track,
        known,
        size=own,
        route=route,
        light=light,
        light_s=light_s,
        state=batch["light_state"][rollout, 1:],
    )
    values = kinematics(track, known) | {
        "nearest_object": (gap, known),
        "time_to_collision": (time_to_collision(*pairs), known),
        "road_edge": (beyond, known),
    }
    return values, {
        "collision": ((gap < 0) & known).any(1),
        "offroad": ((beyond > 0) & known).any(1),
        "red_light": red,
    }


def central(values: Tensor, known: Tensor, angle: bool = False) -> Series:
    """Central difference per second of values [M, T(, C)], known where both neighbours
    are [M, T]; 0 elsewhere."""
    change = values[:, 2:] - values[:, :-2]
    change = (wrap(change) if angle else change) / (2 * DT)
    edge = torch.zeros_like(known[:, :1])
    no_change = torch.zeros_like(values[:, :1])
    both = torch.cat([edge, known[:, 2:] & known[:, :-2], edge], 1)
    change = torch.cat([no_change, change, no_change], 1)
    return torch.where(
        both if change.ndim == both.ndim else both[..., None], change, 0.0
    ), both


def kinematics(track: Tensor, known: Tensor) -> dict[str, Series]:
    """Speed [m/s], its rate, yaw rate [rad/s] and its rate of tracks [M, T, 4]."""
    velocity, moved = central(track[..., :2], known)
    speed = velocity.norm(dim=-1)
    yaw_rate, turned = central(track[..., 2], known, angle=True)
    return {
        "linear_speed": (speed, moved),
        "linear_accel": central(speed, moved),
        "angular_speed": (yaw_rate, turned),
        "angular_accel": central(yaw_rate, turned),
    }


def nearest_object(
    track: Tensor, size: Tensor, others: Tensor, other_size: Tensor, seen: Tensor
) -> Tensor:
    """Signed box distance [M, T] [m] to the nearest other agent (minus the depth of an
    overlap), FAR without one.

    track [M, T, 4], size [M, 2]; others [M, T, N, 4], other_size [M, N, 2]; seen [M, T,
    N]: present, and not the track itself. Circles around and inside the boxes tell
    which pairs can be the nearest; only these are measured.
    """
    apart = (others[..., :2] - track[..., None, :2]).norm(dim=-1)
    outer = (size.norm(dim=-1)[:, None] + other_size.norm(dim=-1))[:, None] / 2
    inner = (size.amin(-1)[:, None] + other_size.amin(-1))[:, None] / 2
    upper = (apart - inner).masked_fill(~seen, FAR).amin(-1, keepdim=True)
    m, t, n = (seen & ((apart - outer <= upper) | (apart <= outer))).nonzero(
        as_tuple=True
    )
    gap = signed_distance(
        track[m, t], size[m], second=others[m, t, n], second_size=other_size[m, n]
    )
    flat = gap.new_full((apart.shape[0] * apart.shape[1],), FAR)
    return flat.scatter_reduce(0, m * apart.shape[1] + t, gap, "amin").view(
        apart.shape[:2]
    )


def time_to_collision(
    track: Tensor, size: Tensor, others: Tensor, other_size: Tensor, seen: Tensor
) -> Tensor:
    """Seconds [M, T], at most TTC_CAP, until the track's front meets the rear of the
    agent ahead at constant speeds.

    The agent ahead is the nearest one whose box lies in the track's own width, within
    AHEAD_ANGLE of its heading. Arguments as in nearest_object.
    """
    cos = track[..., 2].cos()[..., None]
    sin = track[..., 2].sin()[..., None]
    dx, dy = (others[..., k] - track[..., None, k] for k in (0, 1))
    turn = wrap(others[..., 2] - track[..., None, 2])
    length, width = (other_size[:, None, :, k] / 2 for k in (0, 1))
    along = turn.cos().abs() * length + turn.sin().abs() * width
    across = turn.sin().abs() * length + turn.cos().abs() * width
    gap = cos * dx + sin * dy - along - size[:, None, None, 0] / 2
    beside = (
        (cos * dy - sin * dx).abs() - across - size[:, None, None, 1] / 2
    )  # negative: overlap in width
    ahead = seen & (gap > 0) & (beside < 0) & (turn.abs() < AHEAD_ANGLE)
    ahead = ahead & ((beside < -BESIDE) | (turn.abs() < BESIDE_ANGLE))
    nearest = gap.masked_fill(~ahead, torch.inf).min(-1)
    leading = (others[..., 3] * turn.cos()).gather(-1, nearest.indices[..., None])[
        ..., 0
    ]
    closing = track[..., 3] - leading
    time = torch.where(closing > 0, nearest.values / closing.clamp(min=1e-6), torch.inf)
    return time.clamp(max=TTC_CAP)


def beyond_road(states: Tensor, size: Tensor, field: Tensor, origin: Tensor) -> Tensor:
    """Metres [B, T, V] that the worst corner of boxes lies beyond the drivable border
    (< 0 inside).

    states [B, T, V, 4], size [B, V, 2]; field [B, G, G], origin [B, 2] as in
    `scenes.drivable_area.off_road`.
    """
    return off_road(corners(states, size[:, None]), field, origin=origin).amax(-1)


def runs_red_light(
    track: Tensor,
    known: Tensor,
    size: Tensor,
    route: Tensor,
    light: Tensor,
    light_s: Tensor,
    state: Tensor,
) -> Tensor:
    """Bool [M]: the front passes the stop line of one of its route's lights between two
    steps while it is red.

    route [M, P, 2]: the route followed; light [M, K]: indices of its lights (-1 none),
    light_s [M, K]: arc length [m] of their stop lines; state [M, T, L]: of all lights.
    """
    if not state.shape[-1] or not (light >= 0).any():
        return torch.zeros(len(track), dtype=torch.bool, device=track.device)
    front = (
        project_track(track[..., :2], route, known=known, start=BEHIND)[0][:, :, None]
        + size[:, None, :1] / 2
        - light_s[:, None]
    )
    light = light[:, None].expand(
        *state.shape[:2], -1
    )  # [M, T, K]: each step is a row of its own in the look-up
    first = torch.zeros_like(light[..., 0]).flatten()
    red = (
        light_state_at(
            state.flatten(0, 1)[:, None], light.flatten(0, 1), step=first
        ).view(light.shape)
        == LIGHT_RED
    )
    passes = (front[:, :-1] <= 0) & (front[:, 1:] > 0) & red[:, 1:]
    return (passes & (known[:, 1:] & known[:, :-1])[..., None]).any(1).any(-1)


SMOOTHING = 0.1


@dataclass(frozen=True)
class Feature:
    """Its weight in the meta-metric; range and number of bins of its histogram, bins =
    0 for an indication."""

    weight: float
    low: float = 0.0
    high: float = 0.0
    bins: int = 0


FEATURES = {
    "linear_speed": Feature(0.05, 0.0, high=25.0, bins=10),
    "linear_accel": Feature(0.05, -12.0, high=12.0, bins=11),
    "angular_speed": Feature(0.05, -0.628, high=0.628, bins=11),
    "angular_accel": Feature(0.05, -3.14, high=3.14, bins=11),
    "nearest_object": Feature(0.10, -5.0, high=40.0, bins=10),
    "collision": Feature(0.25),
    "time_to_collision": Feature(0.10, 0.0, high=5.0, bins=10),
    "road_edge": Feature(0.05, -20.0, high=40.0, bins=10),
    "offroad": Feature(0.25),
    "red_light": Feature(0.05),
}
STAGES[META_STAGE] = (
    Metric("meta_metric", "realism meta-metric, weighted likelihood of the log"),
    *(
        Metric(
            name,
            f"likelihood of the logged {name.replace('_', ' ')}, weight {feature.weight:g}",
        )
        for name, feature in FEATURES.items()
    ),
    Metric(
        "real_split_half",
        "`real` of one half of the logs against the other",
        decimals=3,
    ),
)
HISTOGRAMS = tuple(name for name, feature in FEATURES.items() if feature.bins)
INDICATIONS = tuple(name for name, feature in FEATURES.items() if not feature.bins)


def bin_index(values: Tensor, feature: Feature) -> Tensor:
    """Bin [...] int64 of values [...]; values outside the range count in the first or
    last bin."""
    position = (values - feature.low) / (feature.high - feature.low) * feature.bins
    return position.floor().long().clamp(0, feature.bins - 1)


def bin_counts(index: Tensor, known: Tensor, bins: int) -> Tensor:
    """Number [M, bins] of known [M, T] values in each bin index [M, T]."""
    empty = torch.zeros(len(index), bins, dtype=torch.float64, device=index.device)
    return empty.scatter_add(1, index, known.double())


def log_probability(counts: Tensor, index: Tensor) -> Tensor:
    """log p [M, T] of bins index [M, T] under the smoothed histogram of counts [M,
    bins]."""
    p = (counts + SMOOTHING) / (
        counts.sum(-1, keepdim=True) + SMOOTHING * counts.shape[-1]
    )
    return p.log().gather(1, index)


def log_bernoulli(hits: Tensor, rollouts: Tensor | float, happened: Tensor) -> Tensor:
    """log p [M] of an indication that happened [M] bool in the log and in `hits` [M] of
    the rollouts."""
    p = (hits + SMOOTHING) / (rollouts + 2 * SMOOTHING)
    return torch.where(happened, p, 1 - p).log()


def likelihood(log_p: Tensor, known: Tensor, scene: Tensor, scenes: int) -> Tensor:
    """exp of the mean log_p [M, T] over the known [M, T] values of each scene [M]
    int64; NaN where it has none."""
    total = log_p.new_zeros(scenes).index_add(0, scene, (log_p * known).sum(-1))
    count = log_p.new_zeros(scenes).index_add(0, scene, known.to(log_p.dtype).sum(-1))
    return (total / count).exp()


def meta_metric(likelihoods: dict[str, Tensor]) -> Tensor:
    """Weighted sum [...] of the features' likelihoods [...]."""
    return sum(
        (feature.weight * likelihoods[name] for name, feature in FEATURES.items()),
        start=torch.zeros(()),
    )
