"""Synthetic rollouts with all a scorer can meet: contacts of all kinds, gaps in tracks,
curved lanes, polygons."""

import math

import torch

from e2rl.sim.rollouts import Rollouts

STEPS = 80
VEHICLES = 32
OTHERS = 16
DT = 0.1


def random_rollouts(
    rollouts: int = 8,
    seed: int = 0,
    vehicles: int = VEHICLES,
    others: int = OTHERS,
    steps: int = STEPS,
    extent: float = 60.0,
) -> Rollouts:
    """Rollouts [B = rollouts, T = steps, N = vehicles + others] as evaluation produces
    them.

    Agents drive constant turns with wavering speed inside +-extent m; some stand, some
    vanish and come back, a third of the rollouts has no polygon, one in eight no map.
    The log is the same tracks, distorted. Rows never valid hold NaN.
    """
    generator = torch.Generator().manual_seed(seed)
    count = vehicles + others
    states = random_tracks(
        rollouts, count, steps=steps, extent=extent, generator=generator
    )
    valid = random_validity(rollouts, count, steps=steps, generator=generator)
    kind = torch.zeros(rollouts, count, dtype=torch.int64)
    kind[:, vehicles:] = torch.randint(1, 4, (rollouts, others), generator=generator)
    simulated = (
        (torch.arange(count) > 0) & (torch.arange(count) < vehicles) & valid.any(1)
    )
    adversaries = simulated & (torch.rand(rollouts, count, generator=generator) < 0.2)
    logged = states + 0.3 * torch.randn(rollouts, 1, count, 4, generator=generator)
    logged[..., 3] = (
        states[..., 3] * 0.9
        + 0.3 * torch.randn(states[..., 3].shape, generator=generator)
    ).abs()
    lengths = torch.where(
        kind == 0,
        3.5 + 8 * torch.rand(rollouts, count, generator=generator).pow(4),
        0.8,
    )
    widths = torch.where(
        kind == 0, 1.6 + 0.9 * torch.rand(rollouts, count, generator=generator), 0.7
    )
    never = ~valid.any(1)[:, None]
    return Rollouts(
        states=states.masked_fill(~valid[..., None] & never[..., None], torch.nan),
        valid=valid,
        size=torch.stack([lengths, widths], -1),
        agent_type=kind,
        simulated=simulated,
        adversaries=adversaries,
        logged=logged,
        logged_valid=valid & (torch.rand(valid.shape, generator=generator) > 0.01),
        **random_map(rollouts, extent, generator=generator),
        seed=torch.arange(rollouts) % 2,
        eta=torch.full((rollouts,), 2.0, dtype=torch.float64),
        scene_id=[f"scene_{index // 2}" for index in range(rollouts)],
        location=[
            f"place_{index // 4}" if index % 8 < 6 else "" for index in range(rollouts)
        ],
        dataset=["synthetic"] * rollouts,
        split=["test"] * rollouts,
        method=["e2"] * rollouts,
        ego_policy=["idm"] * rollouts,
        seconds=torch.rand(rollouts, generator=generator),
        nfe=torch.full((rollouts,), 128.0),
        batch_size=[rollouts],
    )


def sourced(
    rollouts: Rollouts, dataset: str, split: str, method: str, ego: str
) -> Rollouts:
    """The rollouts as those of another source."""
    names = {"dataset": dataset, "split": split, "method": method, "ego_policy": ego}
    return rollouts.replace(
        **{name: [text] * len(rollouts) for name, text in names.items()}
    )


def labelled(
    rows: list[dict], dataset: str, split: str, method: str, ego: str
) -> list[dict]:
    """The rows as those of another source."""
    return [
        row | {"dataset": dataset, "split": split, "method": method, "ego_policy": ego}
        for row in rows
    ]


def random_tracks(rollouts, count, steps, extent, generator):
    def draw(*shape):
        return torch.rand((rollouts, count, *shape), generator=generator)

    speed = 14 * draw() * (draw() > 0.3)
    waver = 1 + 0.4 * torch.sin(
        draw(1) * 6 + torch.arange(steps + 1) * DT * (1 + draw(1))
    )
    speed = speed[..., None] * waver
    turn = (draw() - 0.5) * 0.5 * (draw() > 0.5)
    heading = (draw() * 2 * math.pi)[..., None] + turn[..., None] * torch.arange(
        steps + 1
    ) * DT
    step = speed[..., None] * torch.stack([heading.cos(), heading.sin()], -1) * DT
    position = (draw(2) - 0.5)[:, :, None] * 2 * extent + step.cumsum(2)
    position[:, 0] -= position[:, 0, :1].clone()  # the ego starts at the origin
    tracks = (
        torch.cat([position, heading[..., None], speed[..., None]], -1)
        .transpose(1, 2)
        .contiguous()
    )
    return tracks.float()


def random_validity(rollouts, count, steps, generator):
    """Absent for good, late, gone early or with one gap; the ego is always there."""
    draws = torch.rand(4, rollouts, count, generator=generator)
    begin = torch.where(draws[0] < 0.15, draws[1] * steps, 0.0)
    end = torch.where(draws[2] < 0.2, begin + draws[3] * steps, steps + 1.0)
    time = torch.arange(steps + 1)[:, None]
    gap = torch.rand(rollouts, count, generator=generator) * steps
    valid = (time >= begin[:, None]) & (time <= end[:, None])
    valid &= ~(
        (time >= gap[:, None]) & (time < gap[:, None] + 3) & (draws[1][:, None] > 0.8)
    )
    valid &= (draws[3] > 0.1)[:, None]
    valid[..., 0] = True
    return valid


def random_map(
    rollouts, extent, generator, lanes: int = 12, points: int = 120, polygons: int = 5
):
    """Curved lanes of uneven spacing, and star-shaped polygons that may overlap; padded
    as in a scene batch."""

    def draw(*shape):
        return torch.rand((rollouts, *shape), generator=generator)

    heading = (draw(lanes, 1) * 2 * math.pi) + (
        draw(lanes, 1) - 0.5
    ) * 0.06 * torch.arange(points)
    step = (
        torch.stack([heading.cos(), heading.sin()], -1)
        * (0.3 + 2.5 * draw(lanes, points))[..., None]
    )
    lane = (
        (draw(lanes, 1, 2) - 0.5) * 2 * extent
        - step.sum(2, keepdim=True) / 2
        + step.cumsum(2)
    )
    angle = torch.linspace(0, 2 * math.pi, 31)[:-1]
    radius = extent * (0.15 + 0.3 * draw(polygons, 30))
    ring = torch.stack([angle.cos(), angle.sin()], -1) * radius[..., None]
    ring = ring + (draw(polygons, 1, 2) - 0.5) * 2 * extent
    lane_index = (
        torch.arange(lanes).repeat_interleave(points).expand(rollouts, -1).clone()
    )
    ring_index = (
        torch.arange(polygons).repeat_interleave(30).expand(rollouts, -1).clone()
    )
    ring_index[::3] = -1
    lane_index[
        :, -points // 2 :
    ] = -1  # the last lane is cut short, the rest is padding
    lane_index[5::8], ring_index[5::8] = -1, -1
    width = torch.cat([2.5 + 3.5 * draw(lanes), torch.zeros(rollouts, 4)], -1)
    return {
        "lane_points": lane.flatten(1, 2).float(),
        "lane_index": lane_index,
        "lane_width": width,
        "drivable_points": ring.flatten(1, 2).float(),
        "drivable_index": ring_index,
    }
