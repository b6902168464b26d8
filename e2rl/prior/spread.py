"""How far the prior's samples of one scene lie apart: what is left of the trained
distribution after K steps, and how often the recording lies among them."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior import lane_relative
from e2rl.prior.lane_relative import ACCEL_SCALE, HORIZON, KNOTS, SIZE
from e2rl.prior.prior import Prior
from e2rl.scenes.route import project
from e2rl.sim.world import World

MOVING = 1.0  # m/s, of vehicles that count
REGIONS = {"covered_50": 0.5, "covered_90": 0.9}  # central regions of the samples


@torch.no_grad()
def sample_variances(
    prior: Prior, scene: TensorDictBase, samples: int, seed: int = 0
) -> dict[str, Tensor]:
    """Sums [B] over the moving vehicles on lanes of scenes [B] of the variance over
    `samples` joint samples, and their number: `knots` and `lateral`, mean over the
    knots of x; `travel` [m^2], of the distance after 5 s; `vehicles`. Of those recorded
    for 5 s: in how many the recorded distance lies in each of REGIONS of the samples',
    and their number `recorded`.

    Routes are the recorded ones, drawn where there is none; the ego is sampled like
    every vehicle. So what varies is the reverse SDE alone.
    """
    device = scene["start"].device
    shape = scene["route_log"].shape
    generator = torch.Generator(device).manual_seed(seed)
    drawn_route = prior.choose_routes(
        scene, torch.rand(shape, generator=generator, device=device)
    )
    routed, lane = prior.start(
        scene, torch.where(scene["route_log"] >= 0, scene["route_log"], drawn_route)
    )
    context = prior.encode(routed, lane, World.at_start(scene))
    counted = context.active & routed.has_lane & (lane.v > MOVING)
    drawn = []
    for _ in range(samples):
        noise = torch.randn(
            prior.sampler.steps, *shape, SIZE, generator=generator, device=device
        )
        drawn.append(prior.sample(context, noise).x0)
    x = torch.stack(drawn)
    travel = torch.stack(
        [
            lane_relative.speeds(lane, ACCEL_SCALE * one[..., :KNOTS])[1][..., -1]
            for one in x
        ]
    )
    variance = x.var(0)
    parts = {
        "knots": variance[..., :KNOTS].mean(-1),
        "lateral": variance[..., KNOTS:].mean(-1),
        "travel": travel.var(0),
    }
    sums = {name: (value * counted).sum(-1).double() for name, value in parts.items()}
    at = min(HORIZON, scene["logged"].shape[1] - 1)
    vehicles = shape[1]
    recorded = (
        counted
        & (scene["route_log"] >= 0)
        & scene["logged_valid"][:, at, :vehicles]
        & (at == HORIZON)
    )
    logged = torch.where(
        recorded[..., None],
        scene["logged"][:, at, :vehicles, :2],
        scene["start"][:, :vehicles, :2],
    )
    way = (
        project(
            logged[:, :, None], routed.points, hint=(lane.s + travel.mean(0))[..., None]
        )[0][..., 0]
        - lane.s
    )
    rank = (travel < way).sum(0)
    inside = {
        name: (central(rank, samples, part=part) * recorded).sum(-1).double()
        for name, part in REGIONS.items()
    }
    return (
        sums
        | {"vehicles": counted.sum(-1).double()}
        | inside
        | {"recorded": recorded.sum(-1).double()}
    )


def central(rank: Tensor, samples: int, part: float) -> Tensor:
    """Whether a value of `rank` 0 to `samples` among so many samples lies in their
    central `part`; at its edge a share, so that a value of the samples' own law does in
    exactly `part` of all cases."""
    return (part * (samples + 1) / 2 + 0.5 - (rank - samples / 2).abs()).clamp(0, 1)
