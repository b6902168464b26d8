"""How closely the motion of simulated traffic follows the recordings' distribution
(docs/reference/metrics.md).

Longitudinal and lateral acceleration and |jerk|, from means over blocks of 0.5 s, of
the simulated vehicles other than the ego that move, in frames valid both in the rollout
and in its log. Values are clipped, never dropped, because recorded tracks hold
glitches. With W1_k the Wasserstein-1 distance of quantity k between the pooled samples
of a set of rollouts and of their logs: real = 1 - mean_k min(1, W1_k). real_norm
divides each W1_k by the 5-95% range of the log. real_adv is `real` of the adversaries
alone, against the logs of the same vehicles.
"""

from functools import partial

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Metric, declare
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap

CLIP = {"a_lon": 10.0, "a_lat": 10.0, "jerk": 20.0}  # m/s2, m/s2, m/s3
KINEMATICS = tuple(CLIP)
OF_ADVERSARIES = tuple(f"{name}_adversary" for name in KINEMATICS)
NO_SAMPLES = {
    name: torch.zeros(2, 0) for name in (*KINEMATICS, *OF_ADVERSARIES)
}  # of a rollout
W1 = tuple(f"w1_{name}" for name in KINEMATICS)
BLOCK = round(0.5 / DT)  # steps
MOVING = 0.5  # m/s
COLUMNS = 1024  # sorted samples handled at once: bounds the memory of the bootstrap
Samples = dict[str, Tensor]

_real = partial(Metric, decimals=3)
declare(
    _real(
        "real",
        "realism, 1 - mean capped W1",
        samples="a_lon",
        tables="main traffic adversaries methods",
    ),
    _real(
        "real_adv",
        "realism of the adversaries alone",
        samples=OF_ADVERSARIES[0],
        tables="main adversaries methods public",
    ),
    _real(
        "real_norm",
        "realism, W1 over the log's range",
        samples="a_lon",
        tables="main traffic",
    ),
    Metric(
        "w1_a_lon",
        "W1 of longitudinal acceleration",
        unit="m/s²",
        samples="a_lon",
        tables="traffic",
    ),
    Metric(
        "w1_a_lat",
        "W1 of lateral acceleration",
        unit="m/s²",
        samples="a_lon",
        tables="traffic",
    ),
    Metric(
        "w1_jerk",
        "W1 of |jerk|",
        unit="m/s³",
        samples="a_lon",
        tables="traffic",
    ),
)


def kinematic_samples(
    states: Tensor,
    valid: Tensor,
    logged: Tensor,
    logged_valid: Tensor,
    agents: Tensor,
    stop: Tensor,
) -> list[Samples]:
    """{quantity: [2, n]} per rollout: samples of the rollout (row 0) and of its log
    (row 1), blocks of steps 1..stop.

    Args:
        states, logged: [B, T+1, N, 4].
        valid, logged_valid: [B, T+1, N] bool.
        agents: [B, N] bool, simulated, not the ego.
        stop: [B].
    """
    blocks = (states.shape[1] - 1) // BLOCK
    both = valid & logged_valid
    fastest = torch.maximum(
        *((track[..., 3] * both).abs().amax(1) for track in (states, logged))
    )
    agents = agents & (fastest > MOVING)
    whole = torch.arange(blocks, device=stop.device) < (stop // BLOCK)[:, None]
    complete = by_block(both).all(2) & agents[:, None] & whole[..., None]
    twice = complete[:, 1:] & complete[:, :-1]
    thrice = twice[:, 1:] & twice[:, :-1]
    pair = [block_kinematics(track) for track in (states, logged)]
    result: list[Samples] = [{} for _ in range(len(states))]
    for name, mask in zip(
        KINEMATICS,
        (twice, twice, thrice),
        strict=True,
    ):
        values = torch.stack([motion[name][mask] for motion in pair]).clamp(
            -CLIP[name], CLIP[name]
        )
        for samples, part in zip(
            result,
            values.split(mask.sum((1, 2)).tolist(), 1),
            strict=True,
        ):
            samples[name] = part.clone()
    return result


def traffic_samples(batch: dict[str, Tensor]) -> list[Samples]:
    """`kinematic_samples` per rollout of the traffic, and of the adversaries in it
    under names of their own."""
    traffic = batch["traffic"]
    everybody, adversaries = (
        kinematic_samples(
            batch["states"],
            batch["valid"],
            logged=batch["logged"],
            logged_valid=batch["logged_valid"],
            agents=agents,
            stop=batch["stop"],
        )
        for agents in (traffic, traffic & batch["adversaries"])
    )
    return [
        samples | dict(zip(OF_ADVERSARIES, theirs.values(), strict=True))
        for samples, theirs in zip(everybody, adversaries, strict=True)
    ]


def by_block(values: Tensor) -> Tensor:
    """Steps 1.. of values [B, T+1, N] as [B, blocks, BLOCK, N]."""
    blocks = (values.shape[1] - 1) // BLOCK
    return values[:, 1 : blocks * BLOCK + 1].unflatten(1, (blocks, BLOCK))


def block_kinematics(states: Tensor) -> Samples:
    """a_lon, a_lat [B, blocks - 1, N] [m/s2] and |jerk| [B, blocks - 2, N] [m/s3]
    between the means of blocks."""
    period = BLOCK * DT
    speed = by_block(states[..., 3]).mean(2)
    heading = torch.atan2(
        by_block(states[..., 2].sin()).mean(2), by_block(states[..., 2].cos()).mean(2)
    )
    a_lon = speed.diff(dim=1) / period
    a_lat = (speed[:, 1:] + speed[:, :-1]) / 2 * (wrap(heading.diff(dim=1)) / period)
    return {"a_lon": a_lon, "a_lat": a_lat, "jerk": (a_lon.diff(dim=1) / period).abs()}


def wasserstein(pair: Tensor, cluster: Tensor, draws: Tensor) -> Tensor:
    """W1 [D] between the two samples of pair [2, n], weighted by each draw's
    multiplicity of the samples' clusters.

    cluster [n] int64 below C, draws [D, C] >= 0. W1 is the area between the two
    distribution functions, which are linear in the multiplicities: a cumulative sum per
    cluster serves all draws. NaN for an empty draw.
    """
    values, order = pair.flatten().sort()
    sign = torch.ones_like(pair)
    sign[1] = -1.0
    sign = sign.flatten()[order]
    owner = cluster.repeat(2)[order]
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


def realism(
    samples: list[Samples],
    cluster: Tensor,
    draws: Tensor,
) -> dict[str, Tensor]:
    """real, real_norm, w1_a_lon, w1_a_lat, w1_jerk and real_adv [D] of the pooled
    samples of rollouts.

    samples: one entry of `traffic_samples` per rollout, cluster [R] int64: the
    rollouts' clusters, draws [D, C]: the multiplicities of clusters in each draw. NaN
    where a quantity has no sample.
    """
    return _pooled(
        samples,
        cluster,
        draws=draws,
        names=KINEMATICS,
    ) | {
        "real_adv": _pooled(
            samples,
            cluster,
            draws=draws,
            names=OF_ADVERSARIES,
        )["real"]
    }


def _pooled(
    samples: list[Samples],
    cluster: Tensor,
    draws: Tensor,
    names: tuple[str, ...],
) -> dict[str, Tensor]:
    """`realism` without real_adv, of the samples of these names."""
    distances = []
    ranges = []
    for name in names:
        pair = (
            torch.cat([sample[name] for sample in samples], 1)
            if samples
            else draws.new_zeros(2, 0)
        )
        if not pair.shape[1]:
            return dict.fromkeys(
                ("real", "real_norm", *W1), draws.new_full((len(draws),), torch.nan)
            )
        counts = torch.tensor(
            [sample[name].shape[1] for sample in samples], device=pair.device
        )
        distances.append(
            wasserstein(
                pair,
                cluster.repeat_interleave(counts),
                draws=draws.to(pair),
            )
        )
        log = pair[1].sort().values
        ranges.append(
            (quantile_of_sorted(log, 0.95) - quantile_of_sorted(log, 0.05)).clamp(
                min=1e-9
            )
        )
    distance = torch.stack(distances)
    log_range = torch.stack(ranges)[:, None]
    table = {
        "real": 1 - distance.clamp(max=1).mean(0),
        "real_norm": 1 - (distance / log_range).clamp(max=1).mean(0),
    }
    return table | dict(
        zip(
            W1,
            distances,
            strict=True,
        )
    )


def quantile_of_sorted(values: Tensor, fraction: float) -> Tensor:
    """Linear quantile of sorted values [n]; torch.quantile refuses more than 16 million
    of them."""
    position = fraction * (len(values) - 1)
    low = int(position)
    return torch.lerp(
        values[low],
        values[min(low + 1, len(values) - 1)],
        position - low,
    )
