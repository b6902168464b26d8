"""The prior's training loss: denoising of x plus a small trajectory term, on augmented
windows."""

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from e2rl.prior.denoiser import Denoiser
from e2rl.prior.features import SIDED_EDGE, SIDED_NODE
from e2rl.prior.lane_relative import (
    HORIZON,
    KNOT_STEPS,
    KNOTS,
    SIZE,
    LaneState,
    lateral_horizon,
    offset_coefficients,
    polynomial,
    speeds,
    split,
)
from e2rl.prior.prior import EGO_LEVEL, Prior

LEVELS = 4  # noise levels a window
TRAJECTORY = 0.15  # weight of the trajectory term beside the denoising loss
MIRROR = 0.5  # fraction of mirrored windows
DROP = 0.1  # fraction of other vehicles that are hidden
ACCEL_NOISE = 0.35  # m/s^2 on the current acceleration, in half of the windows
FEATURE_NOISE = 0.1  # on the features, in units of their standard deviations
MIN_STD = 0.02  # smallest standard deviation that a feature is divided by
CONSTANT_STD = 1e6  # for constant features, so that they have no effect
SIDED = {
    "nodes": SIDED_NODE,
    "pairs": SIDED_EDGE,
    "x0": (KNOTS, KNOTS + 1),
}  # columns whose sign a mirror flips


def augment(batch: TensorDictBase, generator: torch.Generator) -> TensorDictBase:
    """Windows [W] mirrored, with noise on the accelerations and some of the other
    vehicles hidden."""
    batch = batch.clone()
    size = batch.shape[0]
    device = batch["x0"].device

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, device=device)

    flip = torch.where(uniform(size) < MIRROR, -1.0, 1.0)
    for key, columns in SIDED.items():
        sign = torch.ones(size, batch[key].shape[-1], device=device)
        sign[:, list(columns)] = flip[:, None]
        batch[key] = batch[key] * sign.reshape(size, *[1] * (batch[key].ndim - 2), -1)
    for key in ("d", "d1", "d2", "aside"):
        batch[key] = batch[key] * flip.reshape(size, *[1] * (batch[key].ndim - 1))
    hidden = uniform(*batch["present"].shape) < DROP
    hidden[:, 0] = False
    batch["present"] = batch["present"] & ~hidden
    batch["weight"] = batch["weight"] * ~hidden
    noisy = (uniform(*batch["a"].shape) < 0.5) * ACCEL_NOISE
    noise = noisy * torch.randn(batch["a"].shape, generator=generator, device=device)
    batch["a"] = batch["a"] + noise
    batch["nodes"][..., 1] += noise / 2
    return batch


def draw(batch: TensorDictBase, generator: torch.Generator) -> TensorDict:
    """The random numbers of the loss of windows [W] at L = LEVELS noise levels each.

    feature [W, R, NODE]: standard normal; level [W, L]: in (0.01, 0.99), stratified;
    clean [W, L] bool: the ego's row is nearly noise-free (in half); noise [W, L, R,
    SIZE]: standard normal.
    """
    size = len(batch)
    count = LEVELS
    device = batch["x0"].device
    feature = torch.randn(batch["nodes"].shape, generator=generator, device=device)
    u = torch.rand(count, size, generator=generator, device=device)
    level = (torch.arange(count, device=device)[:, None] + u) / count * 0.98 + 0.01
    clean = torch.rand(count, size, generator=generator, device=device) < 0.5
    noise = torch.randn(count, *batch["x0"].shape, generator=generator, device=device)
    return TensorDict(
        {
            "feature": feature,
            "level": level.T,
            "clean": clean.T,
            "noise": noise.transpose(0, 1),
        },
        [size],
    )


def loss_weight(batch: TensorDictBase, drawn: TensorDictBase) -> Tensor:
    """[L * W, R], level by level: the windows' weights, 0 for a clean ego row."""
    weight = (
        batch["weight"].expand(drawn["level"].shape[1], *batch["weight"].shape).clone()
    )
    weight[..., 0] *= ~drawn["clean"].T
    return weight.flatten(0, 1)


class DenoisingLoss(nn.Module):
    """The denoiser's loss as a module, so that DistributedDataParallel and
    torch.compile can wrap it."""

    def __init__(self, denoiser: Denoiser, feature_noise: float = FEATURE_NOISE):
        super().__init__()
        self.denoiser = denoiser
        self.feature_noise = feature_noise

    def forward(
        self,
        batch: TensorDictBase,
        drawn: TensorDictBase,
        total: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(loss, its action term, its trajectory term) of windows [W] with the random
        numbers of `draw`.

        total: divisor of the weighted sums, the sum of `loss_weight`, averaged over the
        processes that share a batch so that the mean of their gradients is the gradient
        of the whole batch.
        """
        net = self.denoiser
        count = drawn["level"].shape[1]
        scale = (
            self.feature_noise
            * net.node_std
            * ((net.node_std > MIN_STD) & (net.node_std < CONSTANT_STD))
        )
        nodes = batch["nodes"] + scale * drawn["feature"]
        encoding = net.encode(nodes, batch["pairs"], batch["present"]).repeat(count)
        weight = loss_weight(batch, drawn)
        tiled = TensorDict.cat([batch] * count)
        level = drawn["level"].T.reshape(-1, 1).expand(-1, weight.shape[1]).clone()
        level[:, 0] = torch.where(drawn["clean"].T.reshape(-1), EGO_LEVEL, level[:, 0])
        x = net.schedule.noised(
            tiled["x0"],
            level[..., None],
            drawn["noise"].transpose(0, 1).flatten(0, 1),
        )
        x0 = net(x, level, encoding).float()
        squared = (x0 - tiled["x0"]) ** 2 * tiled["knot_weight"]
        action = (squared.sum(-1) / SIZE * weight).sum() / total
        trajectory = (_trajectory_error(x0, tiled) * weight).sum() / total
        return action + TRAJECTORY * trajectory, action.detach(), trajectory.detach()


def _trajectory_error(x0: Tensor, batch: TensorDictBase) -> Tensor:
    """Huber error [W, R] in m of travelled distance and (twice, on lanes) of offset at
    the knots' times."""
    zero = torch.zeros_like(batch["v"])
    state = LaneState(
        zero,
        batch["d"],
        d1=batch["d1"],
        d2=batch["d2"],
        v=batch["v"],
        a=batch["a"],
        x=zero,
        y=zero,
        heading=zero,
        kappa=zero,
    )
    knots, half, end = split(x0, state)
    travelled = speeds(state, knots)[1][..., KNOT_STEPS - 1 : HORIZON : KNOT_STEPS]
    u = (travelled / lateral_horizon(state.v)[..., None]).clamp(max=1.0)
    d = polynomial(offset_coefficients(state, half, end=end), u)[0]
    ahead = F.huber_loss(travelled, batch["ahead"], reduction="none")
    aside = (
        F.huber_loss(2 * d, 2 * batch["aside"], reduction="none")
        * batch["on_lane"][..., None]
    )
    return ((ahead + aside) * batch["known"].float()).sum(-1) / KNOTS


@torch.no_grad()
def held_out_loss(
    prior: Prior,
    windows: TensorDictBase,
    *,
    batch: int,
    batches: int = 20,
) -> float:
    """Returns the denoising loss, with a fixed seed and without augmentation.

    Args:
        prior: that is measured.
        windows: [W].
        batch: windows at once.
        batches: of which so many are taken at most.
    """
    device = next(prior.parameters()).device
    generator = torch.Generator(device).manual_seed(1)
    measure = DenoisingLoss(prior.denoiser, feature_noise=0.0)
    losses = []
    for part in windows[: batches * batch].to(device).split(batch):
        drawn = draw(part, generator)
        total = loss_weight(part, drawn).sum().clamp(min=1)
        losses.append(measure(part, drawn, total)[0].item())
    return sum(losses) / len(losses)
