"""Training the prior: denoising loss in x with a small trajectory term, route choice, EMA, exact resume."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from e2rl.prior.features import SIDED_EDGE, SIDED_NODE
from e2rl.prior.lane_relative import (
    HORIZON,
    KNOT_STEPS,
    KNOTS,
    SIZE,
    LaneState,
    _polynomial,
    lateral_horizon,
    offset_coefficients,
    speeds,
    split,
)
from e2rl.prior.prior import CLEAN, Prior
from e2rl.prior.route_choice import candidate_features


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
    x = net.schedule.alpha(level)[..., None] * batch["x0"] + net.schedule.sigma(level)[..., None] * eps
    x0 = net(x, level, encoding).float()
    weight = batch["weight"] * torch.cat([(~clean)[:, None].float(), torch.ones_like(batch["weight"][:, 1:])], 1)
    total = weight.sum().clamp(min=1)
    squared = (x0 - batch["x0"]) ** 2 * batch["knot_weight"]
    action = (squared.sum(-1) / SIZE * weight).sum() / total
    trajectory = (_trajectory_error(x0, batch) * weight).sum() / total
    return action + settings.trajectory * trajectory, {"action": action.detach(), "trajectory": trajectory.detach()}


def _trajectory_error(x0: Tensor, batch: TensorDictBase) -> Tensor:
    """Huber error [W, R] of way ahead and (twice) of offset at the knots' times, in m."""
    zero = torch.zeros_like(batch["v"])
    state = LaneState(zero, batch["d"], batch["d1"], batch["d2"], batch["v"], batch["a"], zero, zero, zero, zero)
    knots, half, end = split(x0, state)
    _, travelled = speeds(state, knots)
    ends = torch.arange(KNOT_STEPS - 1, HORIZON, KNOT_STEPS, device=x0.device)
    travelled = travelled[..., ends]
    u = (travelled / lateral_horizon(state.v)[..., None]).clamp(max=1.0)
    d = _polynomial(offset_coefficients(state, half, end), u)[0]
    known = batch["known"].float()
    ahead = F.huber_loss(travelled, batch["ahead"], reduction="none")
    aside = F.huber_loss(2 * d, 2 * batch["aside"], reduction="none")
    return ((ahead + aside) * known).sum(-1) / KNOTS


def train_route_choice(prior: Prior, scenes: TensorDictBase, settings: TrainingSettings) -> float:
    """Cross-entropy on the candidate driven, over vehicles with a choice; returns the accuracy on the training set."""
    parts = [candidate_features(scenes[i:i + 64]) for i in range(0, len(scenes), 64)]
    features = torch.cat(parts)
    valid, label = scenes["route_valid"], scenes["route_log"]
    use = scenes["valid"][:, :label.shape[1]] & ~scenes["parked"][:, :label.shape[1]] & (label >= 0)
    use &= valid.sum(-1) > 1
    use[:, 0] &= label[:, 0] >= 0
    features, valid, label = features[use], valid[use], label[use]
    if not len(label):
        return float("nan")
    generator = torch.Generator().manual_seed(settings.seed)
    optimiser = torch.optim.AdamW(prior.route_choice.parameters(), 3e-3, weight_decay=0.05)
    for _ in tqdm(range(settings.route_steps), "route choice"):
        pick = torch.randint(len(label), (512,), generator=generator)
        sample = features[pick]
        sample = sample + 0.05 * torch.randn(sample.shape, generator=generator)
        logits = prior.route_choice.net(sample)[..., 0].masked_fill(~valid[pick], -1e4)
        loss = F.cross_entropy(logits, label[pick], label_smoothing=0.0)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        logits = prior.route_choice.net(features)[..., 0].masked_fill(~valid, -torch.inf)
    return (logits.argmax(-1) == label).float().mean().item()


class PriorTraining:
    """The state of one training run: network, its moving average, optimiser, progress and generator."""

    def __init__(self, prior: Prior, windows: TensorDictBase, settings: TrainingSettings):
        self.prior, self.windows, self.settings, self.step = prior, windows, settings, 0
        self.device = next(prior.parameters()).device
        self.generator = torch.Generator(self.device).manual_seed(settings.seed)
        nodes = windows["nodes"][windows["present"]]
        prior.denoiser.node_mean.copy_(nodes.mean(0))
        prior.denoiser.node_std.copy_(nodes.std(0).clamp(min=0.02))
        self.optimiser = torch.optim.AdamW(prior.denoiser.parameters(), settings.learning_rate,
                                           weight_decay=settings.weight_decay)
        self.average = {key: value.clone() for key, value in prior.denoiser.state_dict().items()}

    def learning_rate(self) -> float:
        """Linear warm-up over 50 steps, then a cosine to 0."""
        warm = min(1.0, (self.step + 1) / 50)
        done = torch.tensor(self.step / self.settings.steps * torch.pi)
        return self.settings.learning_rate * warm * 0.5 * (1 + torch.cos(done).item())

    def run(self, until: int) -> dict[str, float]:
        """Train up to step `until`; returns the running losses."""
        running: dict[str, float] = {}
        bar = tqdm(range(self.step, until), "prior", initial=self.step, total=self.settings.steps, unit="step")
        for _ in bar:
            pick = torch.randint(len(self.windows), (self.settings.batch,), generator=self.generator,
                                 device=self.device).to(self.windows["x0"].device)
            batch = augment(self.windows[pick].to(self.device), self.settings, self.generator)
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.bf16):
                loss, parts = denoising_loss(self.prior, batch, self.settings, self.generator)
            for group in self.optimiser.param_groups:
                group["lr"] = self.learning_rate()
            self.optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.prior.denoiser.parameters(), 1.0)
            self.optimiser.step()
            self.step += 1
            decay = min(self.settings.ema, (1 + self.step) / (10 + self.step))
            for key, value in self.prior.denoiser.state_dict().items():
                self.average[key].lerp_(value, 1 - decay)
            if self.step % 20 == 0:
                for key, value in parts.items():
                    running[key] = 0.9 * running.get(key, value.item()) + 0.1 * value.item()
                bar.set_postfix({key: f"{value:.3f}" for key, value in running.items()})
        return running

    def averaged(self) -> Prior:
        """The prior with the averaged weights in place (the raw ones are kept by `swap`)."""
        self.prior.denoiser.load_state_dict(self.average)
        return self.prior

    def state_dict(self) -> dict:
        """Everything that exact resumption needs."""
        return {"denoiser": self.prior.denoiser.state_dict(), "route_choice": self.prior.route_choice.state_dict(),
                "average": self.average, "optimiser": self.optimiser.state_dict(), "step": self.step,
                "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict) -> None:
        """Go on from a `state_dict`."""
        self.prior.denoiser.load_state_dict(state["denoiser"])
        self.prior.route_choice.load_state_dict(state["route_choice"])
        self.average = {key: value.clone() for key, value in state["average"].items()}
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = state["step"]
        self.generator.set_state(state["generator"].cpu())


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


