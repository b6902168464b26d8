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
    prior: Prior,
    scene: TensorDictBase,
    samples: int,
    seed: int = 0,
) -> dict[str, Tensor]:
    """Sums [B] over the moving vehicles on lanes of scenes [B].

    Routes are the recorded ones, drawn where there is none; the ego is sampled like
    every vehicle. So what varies is the reverse SDE alone.

    Args:
        prior: to sample from.
        scene: scenes [B].
        samples: number of joint samples.
        seed: of these.

    Returns:
        Variance over the samples: `knots` and `lateral`, mean over the knots of x;
        `travel` [m^2], of the distance after 5 s; and the number of `vehicles`. Of
        those recorded for 5 s: in how many the recorded distance lies in each of
        REGIONS of the samples', and their number `recorded`.
    """
    device = scene["start"].device
    shape = scene["route_log"].shape
    generator = torch.Generator(device).manual_seed(seed)
    drawn_route = prior.choose_routes(
        scene,
        torch.rand(
            shape,
            generator=generator,
            device=device,
        ),
    )
    routed, lane = prior.start(
        scene, torch.where(scene["route_log"] >= 0, scene["route_log"], drawn_route)
    )
    context = prior.encode(routed, lane, World.at_start(scene))
    counted = context.active & routed.has_lane & (lane.v > MOVING)
    drawn = []
    for _ in range(samples):
        noise = torch.randn(
            prior.sampler.steps,
            *shape,
            SIZE,
            generator=generator,
            device=device,
        )
        drawn.append(prior.sample(context, noise).x0)
    x = torch.stack(drawn)
    travel = torch.stack(
        [
            lane_relative.speeds(lane, ACCEL_SCALE * sample[..., :KNOTS])[1][..., -1]
            for sample in x
        ]
    )
    variance = x.var(0)
    numbers = {
        "knots": variance[..., :KNOTS].mean(-1) * counted,
        "lateral": variance[..., KNOTS:].mean(-1) * counted,
        "travel": travel.var(0) * counted,
        "vehicles": counted,
    }
    vehicles = shape[1]
    last = min(HORIZON, scene["logged"].shape[1] - 1)
    recorded = counted & (scene["route_log"] >= 0)
    recorded = recorded & scene["logged_valid"][:, last, :vehicles] & (last == HORIZON)
    xy = torch.where(
        recorded[..., None],
        scene["logged"][:, last, :vehicles, :2],
        scene["start"][:, :vehicles, :2],
    )
    hint = (lane.s + travel.mean(0))[..., None]
    place = project(xy[:, :, None], routed.points, hint=hint)[0][..., 0]
    rank = (travel < place - lane.s).sum(0)
    for name, part in REGIONS.items():
        numbers[name] = central(rank, samples, part=part) * recorded
    numbers["recorded"] = recorded
    return {name: value.sum(-1).double() for name, value in numbers.items()}


def central(rank: Tensor, samples: int, part: float) -> Tensor:
    """Whether a value of `rank` 0 to `samples` among so many samples lies in their
    central `part`; at its edge a share, so that a value of the samples' own law does in
    exactly `part` of all cases."""
    return (part * (samples + 1) / 2 + 0.5 - (rank - samples / 2).abs()).clamp(0, 1)
