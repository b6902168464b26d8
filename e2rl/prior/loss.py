"""The prior's loss: denoising in x with a small trajectory term, on augmented windows."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor

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
from e2rl.prior.prior import CLEAN, Prior


@dataclass(frozen=True)
class TrainingSettings:
    """Optimisation steps; windows a batch and noise levels a window; peak learning rate; weight decay; EMA decay;
    weight of the trajectory term; share of other vehicles hidden; feature noise [standard deviations]; noise on the
    current acceleration [m/s^2]; share of windows that are mirrored; bf16 autocast; route-choice steps; seed."""

    steps: int = 3000
    batch: int = 32
    levels: int = 4
    learning_rate: float = 1e-3
    weight_decay: float = 0.1
    ema: float = 0.998
    trajectory: float = 0.5
    drop: float = 0.1
    feature_noise: float = 0.1
    accel_noise: float = 0.35
    mirror: float = 0.5
    bf16: bool = True
    route_steps: int = 600
    seed: int = 0


def augment(batch: TensorDictBase, settings: TrainingSettings, generator: torch.Generator) -> TensorDictBase:
    """Mirrored, noisy windows with some of the other vehicles hidden."""
    batch, size, device = batch.clone(), batch.shape[0], batch["x0"].device
    draw = lambda *shape: torch.rand(shape, generator=generator, device=device)  # noqa: E731
    flip = torch.where(draw(size) < settings.mirror, -1.0, 1.0)
    for key, columns in (("nodes", SIDED_NODE), ("pairs", SIDED_EDGE), ("x0", (KNOTS, KNOTS + 1))):
        sign = torch.ones(batch[key].shape[-1], device=device)
        sign = torch.where(torch.isin(torch.arange(len(sign), device=device), torch.tensor(columns, device=device)),
                           flip[:, None], sign)
        batch[key] = batch[key] * sign.reshape(size, *[1] * (batch[key].ndim - 2), -1)
    for key in ("d", "d1", "d2", "aside"):
        batch[key] = batch[key] * flip.reshape(size, *[1] * (batch[key].ndim - 1))
    hidden = draw(*batch["present"].shape) < settings.drop
    hidden[:, 0] = False
    batch["present"] = batch["present"] & ~hidden
    batch["weight"] = batch["weight"] * ~hidden
    noisy = (draw(*batch["a"].shape) < 0.5) * settings.accel_noise
    noise = noisy * torch.randn(batch["a"].shape, generator=generator, device=device)
    batch["a"] = batch["a"] + noise
    batch["nodes"] = batch["nodes"] + torch.cat([
        torch.zeros_like(noise)[..., None], noise[..., None] / 2,
        torch.zeros_like(batch["nodes"][..., 2:])], -1)
    return batch


def denoising_loss(prior: Prior, batch: TensorDictBase, settings: TrainingSettings, generator: torch.Generator
                   ) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss of a batch of windows [W] at `levels` noise levels each, stratified; the ego's row is clean in half."""
    net, count = prior.denoiser, settings.levels
    size, rows = batch["present"].shape
    device = batch["x0"].device
    noise = torch.randn(batch["nodes"].shape, generator=generator, device=device)
    nodes = batch["nodes"] + settings.feature_noise * net.node_std * noise * (net.node_std > 0.02)
    encoding = net.encode(nodes, batch["pairs"], batch["present"]).repeat(count)
    batch = torch.cat([batch] * count)
    u = torch.rand(count, size, generator=generator, device=device)
    level = ((torch.arange(count, device=device)[:, None] + u) / count).reshape(-1) * 0.98 + 0.01
    clean = torch.rand(count * size, generator=generator, device=device) < 0.5
    level = level[:, None].expand(-1, rows).clone()
    level[:, 0] = torch.where(clean, CLEAN, level[:, 0])
    eps = torch.randn(batch["x0"].shape, generator=generator, device=device)
    x = net.schedule.noised(batch["x0"], level[..., None], eps)
    x0 = net(x, level, encoding).float()
    weight = batch["weight"] * torch.cat([(~clean)[:, None].float(), torch.ones_like(batch["weight"][:, 1:])], 1)
    total = weight.sum().clamp(min=1)
    squared = (x0 - batch["x0"]) ** 2 * batch["knot_weight"]
    action = (squared.sum(-1) / SIZE * weight).sum() / total
    trajectory = (_trajectory_error(x0, batch) * weight).sum() / total
    return action + settings.trajectory * trajectory, {"action": action.detach(), "trajectory": trajectory.detach()}


def _trajectory_error(x0: Tensor, batch: TensorDictBase) -> Tensor:
    """Huber error [W, R] of way ahead and (twice, on lanes) of offset at the knots' times, in m."""
    zero = torch.zeros_like(batch["v"])
    state = LaneState(zero, batch["d"], batch["d1"], batch["d2"], batch["v"], batch["a"], zero, zero, zero, zero)
    knots, half, end = split(x0, state)
    _, travelled = speeds(state, knots)
    ends = torch.arange(KNOT_STEPS - 1, HORIZON, KNOT_STEPS, device=x0.device)
    travelled = travelled[..., ends]
    u = (travelled / lateral_horizon(state.v)[..., None]).clamp(max=1.0)
    d = polynomial(offset_coefficients(state, half, end), u)[0]
    known = batch["known"].float()
    ahead = F.huber_loss(travelled, batch["ahead"], reduction="none")
    aside = F.huber_loss(2 * d, 2 * batch["aside"], reduction="none") * batch["on_lane"][..., None]
    return ((ahead + aside) * known).sum(-1) / KNOTS


@torch.no_grad()
def held_out_loss(prior: Prior, windows: TensorDictBase, settings: TrainingSettings, batches: int = 20) -> float:
    """Denoising loss on windows, with a fixed seed and no augmentation."""
    device = next(prior.parameters()).device
    generator = torch.Generator(device).manual_seed(1)
    plain = TrainingSettings(**{**vars(settings), "feature_noise": 0.0})
    losses = []
    for k in range(min(batches, len(windows) // settings.batch + 1)):
        batch = windows[k * settings.batch:(k + 1) * settings.batch].to(device)
        if len(batch):
            losses.append(denoising_loss(prior, batch, plain, generator)[0].item())
    return sum(losses) / len(losses)
