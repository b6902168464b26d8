"""How far the prior's samples of one scene lie apart: what is left of the trained distribution after K steps."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior import lane_relative
from e2rl.prior.lane_relative import ACCEL_SCALE, KNOTS, SIZE
from e2rl.prior.prior import Prior

MOVING = 1.0  # m/s, of vehicles that count


@torch.no_grad()
def sample_variances(prior: Prior, scene: TensorDictBase, samples: int, seed: int = 0) -> dict[str, Tensor]:
    """Sums [B] over the moving vehicles on lanes of scenes [B] of the variance over `samples` joint samples, and their
    number: `knots` and `lateral`, mean over the knots of x; `travel` [m^2], of the way after 5 s; `vehicles`.

    Routes are drawn once, and the ego is sampled like every vehicle, so that what varies is the reverse SDE alone.
    """
    device, shape = scene["start"].device, scene["route_log"].shape
    generator = torch.Generator(device).manual_seed(seed)
    uniform = torch.rand(shape, generator=generator, device=device)
    routed, lane = prior.start(scene, prior.choose_routes(scene, uniform))
    step = torch.zeros(shape[0], dtype=torch.long, device=device)
    context = prior.encode(routed, lane, scene["start"], scene["valid"], step, None)
    counted = context.active & routed.has_lane & (lane.v > MOVING)
    drawn = []
    for _ in range(samples):
        noise = torch.randn(prior.sampler.steps, *shape, SIZE, generator=generator, device=device)
        drawn.append(prior.sample(context, noise).x0)
    x = torch.stack(drawn)
    travel = torch.stack([lane_relative.speeds(lane, ACCEL_SCALE * one[..., :KNOTS])[1][..., -1] for one in x]).var(0)
    variance = x.var(0)
    parts = {"knots": variance[..., :KNOTS].mean(-1), "lateral": variance[..., KNOTS:].mean(-1), "travel": travel}
    sums = {name: (value * counted).sum(-1).double() for name, value in parts.items()}
    return sums | {"vehicles": counted.sum(-1).double()}
