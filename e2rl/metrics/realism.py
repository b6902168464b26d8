"""How like the recording the simulated traffic moves (design.md section 5, method_and_baselines.md section 8.8).

Longitudinal and lateral acceleration and |jerk| on means over blocks of 0.5 s, of the simulated vehicles other than the
ego that move, in frames valid in both the rollout and its log; clipped (recorded tracks hold glitches), never dropped.
real = 1 - mean_k min(1, W1_k) over the pooled samples of a set of rollouts; real_norm divides W1_k by the log's 5-95%
range. real_adv is `real` of the adversaries alone, against the logs of the same vehicles.
"""

import torch
from torch import Tensor

from e2rl.sim.dynamics import wrap

FEATURES = ("a_lon", "a_lat", "jerk")
OF_ADVERSARIES = tuple(f"{name}_adversary" for name in FEATURES)
CLIP = {"a_lon": 10.0, "a_lat": 10.0, "jerk": 20.0}  # m/s2, m/s2, m/s3
BLOCK = 0.5  # s
MOVING = 0.5  # m/s
COLUMNS = 8192  # sorted samples handled at once: bounds the memory of the bootstrap


def motion_features(
    states: Tensor, valid: Tensor, logged: Tensor, logged_valid: Tensor, agents: Tensor, stop: Tensor, dt: float
) -> list[dict[str, Tensor]]:
    """Per rollout {feature: [2, n]}: samples of the rollout (row 0) and of its log (row 1), blocks of steps 1..stop.

    states, logged [B, T+1, N, 4], their validity [B, T+1, N], agents [B, N] bool (simulated, not the ego), stop [B].
    """
    block = max(round(BLOCK / dt), 1)
    blocks = (states.shape[1] - 1) // block
    both = valid & logged_valid
    fastest = torch.maximum(*((track[..., 3] * both).abs().amax(1) for track in (states, logged)))
    agents = agents & (fastest > MOVING)
    whole = torch.arange(blocks, device=stop.device) < (stop // block)[:, None]
    known = by_block(both, block, blocks).all(2) & agents[:, None] & whole[..., None]
    twice = known[:, 1:] & known[:, :-1]
    thrice = twice[:, 1:] & twice[:, :-1]
    pair = [block_motion(track, block, blocks, block * dt) for track in (states, logged)]
    result = [{} for _ in range(len(states))]
    for name, mask in zip(FEATURES, (twice, twice, thrice), strict=True):
        sample = torch.stack([motion[name][mask] for motion in pair]).clamp(-CLIP[name], CLIP[name])
        for features, part in zip(result, sample.split(mask.sum((1, 2)).tolist(), 1), strict=True):
            features[name] = part.clone()
    return result


def traffic_features(
    states: Tensor,
    valid: Tensor,
    logged: Tensor,
    logged_valid: Tensor,
    agents: Tensor,
    adversaries: Tensor,
    stop: Tensor,
    dt: float,
) -> list[dict[str, Tensor]]:
    """`motion_features` of agents, and of those of them that are adversaries [B, N] under names of their own."""
    tracks = states, valid, logged, logged_valid
    everybody = motion_features(*tracks, agents, stop, dt)
    theirs = motion_features(*tracks, agents & adversaries, stop, dt)
    return [
        sample | dict(zip(OF_ADVERSARIES, own.values(), strict=True))
        for sample, own in zip(everybody, theirs, strict=True)
    ]


def by_block(values: Tensor, block: int, blocks: int) -> Tensor:
    """Steps 1.. of values [B, T+1, N] as [B, blocks, block, N]."""
    return values[:, 1 : blocks * block + 1].unflatten(1, (blocks, block))


def block_motion(states: Tensor, block: int, blocks: int, period: float) -> dict[str, Tensor]:
    """a_lon, a_lat [B, blocks - 1, N] [m/s2] and |jerk| [B, blocks - 2, N] [m/s3] between blocks `period` s apart."""
    speed = by_block(states[..., 3], block, blocks).mean(2)
    heading = torch.atan2(
        by_block(states[..., 2].sin(), block, blocks).mean(2), by_block(states[..., 2].cos(), block, blocks).mean(2)
    )
    a_lon = speed.diff(dim=1) / period
    yaw_rate = wrap(heading.diff(dim=1)) / period
    return {
        "a_lon": a_lon,
        "a_lat": (speed[:, 1:] + speed[:, :-1]) / 2 * yaw_rate,
        "jerk": (a_lon.diff(dim=1) / period).abs(),
    }


def wasserstein(pair: Tensor, cluster: Tensor, draws: Tensor) -> Tensor:
    """W1 [D] between the two samples of pair [2, n], weighted by each draw's multiplicity of the samples' clusters.

    cluster [n] int64 below C, draws [D, C] >= 0. W1 is the area between the two distribution functions; these are
    linear in the multiplicities, so one cumulative sum per cluster and a matrix product serve all draws. NaN for an
    empty draw.
    """
    values, order = pair.flatten().sort()
    sign = torch.ones_like(pair)
    sign[1] = -1.0
    sign, owner = sign.flatten()[order], cluster.repeat(2)[order]
    step = torch.cat([values.diff(), values.new_zeros(1)])
    height = values.new_zeros(draws.shape[1])
    area = values.new_zeros(draws.shape[0])
    for begin in range(0, len(values), COLUMNS):
        part = slice(begin, begin + COLUMNS)
        jump = values.new_zeros(draws.shape[1], len(sign[part]))
        jump[owner[part], torch.arange(jump.shape[1], device=jump.device)] = sign[part]
        level = height[:, None] + jump.cumsum(1)
        area = area + (draws @ level).abs() @ step[part]
        height = level[:, -1]
    count = draws @ torch.bincount(cluster, minlength=draws.shape[1]).to(draws.dtype)
    return torch.where(count > 0, area / count, torch.nan)


def realism(features: list[dict[str, Tensor]], cluster: Tensor, draws: Tensor) -> dict[str, Tensor]:
    """real, real_norm, w1_a_lon, w1_a_lat, w1_jerk and real_adv [D] of the pooled samples of rollouts, per draw of
    clusters [D, C].

    features as from `traffic_features`, one entry per rollout of cluster [R] int64. NaN where a feature has no sample.
    """
    adversaries = _pooled(features, cluster, draws, OF_ADVERSARIES)
    return _pooled(features, cluster, draws, FEATURES) | {"real_adv": adversaries["real"]}


def _pooled(features: list[dict[str, Tensor]], cluster: Tensor, draws: Tensor, names: tuple[str, ...]):
    """`realism` but for real_adv, of the samples of these names."""
    parts, ranges = [], []
    for name in names:
        pair = torch.cat([sample[name] for sample in features], 1) if features else draws.new_zeros(2, 0)
        if not pair.shape[1]:
            return {key: draws.new_full((len(draws),), torch.nan) for key in ("real", "real_norm", *w1_names())}
        counts = torch.tensor([sample[name].shape[1] for sample in features], device=pair.device)
        parts.append(wasserstein(pair, cluster.repeat_interleave(counts), draws.to(pair)))
        log = pair[1].sort().values
        ranges.append((quantile_of_sorted(log, 0.95) - quantile_of_sorted(log, 0.05)).clamp(min=1e-9))
    distance, spread = torch.stack(parts), torch.stack(ranges)[:, None]
    table = {"real": 1 - distance.clamp(max=1).mean(0), "real_norm": 1 - (distance / spread).clamp(max=1).mean(0)}
    return table | dict(zip(w1_names(), parts, strict=True))


def split_half(features: list[dict[str, Tensor]], cluster: Tensor, halves: Tensor) -> Tensor:
    """`real` [S] of one half of the logs against the other: the ceiling that sampling and the scenes' variety set.

    halves [S, C] bool: which clusters of rollouts (cluster [R]) are in the first half of each split; NaN where a half
    is empty.
    """
    parts = []
    for name in FEATURES:
        log = torch.cat([sample[name][1] for sample in features])
        counts = torch.tensor([sample[name].shape[1] for sample in features])
        owner = cluster.repeat_interleave(counts)
        values, order = log.sort()
        first = halves[:, owner[order]].to(log)
        share = [side.cumsum(1) / side.sum(1, keepdim=True) for side in (first, 1 - first)]
        known = (first > 0).any(1) & (first < 1).any(1)
        parts.append(((share[0] - share[1]).abs()[:, :-1] @ values.diff()).where(known, torch.nan))
    return 1 - torch.stack(parts).clamp(max=1).mean(0)


def w1_names() -> list[str]:
    return [f"w1_{name}" for name in FEATURES]


def quantile_of_sorted(values: Tensor, share: float) -> Tensor:
    """Linear quantile of sorted values [n]; torch.quantile refuses more than 16 million of them."""
    position = share * (len(values) - 1)
    low = int(position)
    return torch.lerp(values[low], values[min(low + 1, len(values) - 1)], position - low)
