"""Optimising the denoiser: the state of one run, its steps, the moving average of the weights, exact resume."""

import math
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from tqdm import tqdm

from e2rl.errors import InputError
from e2rl.learning.prior_training.distributed import ALONE, Processes
from e2rl.learning.prior_training.loss import CONSTANT, LEAST, DenoisingLoss, augment, draw, loss_weight
from e2rl.learning.prior_training.settings import TrainingSettings
from e2rl.prior.prior import Prior

WARM_UP = 50  # steps
RANK_SEED = 1_000_003  # between the generators' seeds of two processes


class PriorTraining:
    """The state of one training run: network, its moving average, optimiser, progress and generator.

    Of `count` processes each draws its own share of a step's windows and noise; their gradients are averaged, hence
    weights and averages are the same in all of them, and a run is determined by its seed and their number.
    """

    def __init__(self, prior: Prior, windows: TensorDictBase, settings: TrainingSettings, processes: Processes = ALONE):
        if settings.batch % processes.count:
            raise InputError(
                f"prior.training.batch={settings.batch}: {processes.count} processes share the windows of "
                "a step evenly; choose a multiple of their number"
            )
        self.prior, self.windows, self.settings, self.processes = prior, windows, settings, processes
        self.step, self.share = 0, settings.batch // processes.count
        self.device = next(prior.parameters()).device
        self.generator = torch.Generator(self.device).manual_seed(settings.seed + RANK_SEED * processes.rank)
        nodes = windows["nodes"][windows["present"]]
        spread = nodes.std(0)
        prior.denoiser.node_mean.copy_(nodes.mean(0))
        prior.denoiser.node_std.copy_(torch.where(spread < 1e-6, CONSTANT, spread.clamp(min=LEAST)))
        self.rows = [
            rows for rows in (windows["causal"].nonzero()[:, 0], (~windows["causal"]).nonzero()[:, 0]) if len(rows)
        ]
        processes.same(prior)
        loss = processes.averaging(DenoisingLoss(prior.denoiser, settings))
        self.loss = torch.compile(loss) if settings.compile else loss
        self.optimiser = torch.optim.AdamW(
            prior.denoiser.parameters(), settings.learning_rate, weight_decay=settings.weight_decay, fused=True
        )
        self.average = {key: value.clone() for key, value in prior.denoiser.state_dict().items()}

    def learning_rate(self) -> float:
        """Linear warm-up, then a cosine to 0."""
        warm = min(1.0, (self.step + 1) / WARM_UP)
        return self.settings.learning_rate * warm * 0.5 * (1 + math.cos(self.step / self.settings.steps * math.pi))

    def run(self, until: int) -> dict[str, float]:
        """Train up to step `until`; returns the running losses."""
        running: dict[str, float] = {}
        self.prior.train()
        bar = tqdm(range(self.step, until), "prior", initial=self.step, total=self.settings.steps, unit="step")
        for _ in bar:
            batch = augment(self.windows[self.pick()].to(self.device), self.settings, self.generator)
            parts = self.update(batch, draw(batch, self.settings, self.generator))
            if self.step % 20 == 0:
                for key, value in zip(("action", "trajectory"), self.processes.mean(parts).tolist(), strict=True):
                    running[key] = 0.9 * running.get(key, value) + 0.1 * value
                bar.set_postfix({key: f"{value:.3f}" for key, value in running.items()})
        return running

    def pick(self) -> torch.Tensor:
        """The windows of a step [share]: a share `causal` of them with estimated starts, where there are both kinds."""
        draw = torch.rand(2, self.share, generator=self.generator, device=self.device).to(self.rows[0].device)
        picks = [rows[(draw[1] * len(rows)).long()] for rows in self.rows]
        return torch.where(draw[0] < self.settings.causal, picks[0], picks[-1])

    def update(self, batch: TensorDictBase, drawn: TensorDictBase) -> torch.Tensor:
        """One step on this process's windows with the random numbers of `loss.draw`; returns the loss's terms [2]."""
        # Dropout's draws follow step and process, so that a run that was interrupted repeats them.
        torch.manual_seed(self.settings.seed + RANK_SEED * (self.step * self.processes.count + self.processes.rank))
        total = self.processes.mean(loss_weight(batch, drawn).sum()).clamp(min=1)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.bf16):
            loss, action, trajectory = self.loss(batch, drawn, total)
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
        return torch.stack([action, trajectory])

    @contextmanager
    def averaged(self):
        """Within this context the prior holds the averaged weights, ready to drive."""
        raw = {key: value.clone() for key, value in self.prior.denoiser.state_dict().items()}
        self.prior.denoiser.load_state_dict(self.average)
        self.prior.eval()
        try:
            yield self.prior
        finally:
            self.prior.denoiser.load_state_dict(raw)

    def state_dict(self) -> dict:
        """Everything that exact resumption needs. Collective: all processes ask for it at once."""
        return {
            "denoiser": self.prior.denoiser.state_dict(),
            "route_choice": self.prior.route_choice.state_dict(),
            "average": self.average,
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "generators": self.processes.gather(self.generator.get_state().cpu()),
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from a `state_dict`; InputError where another number of processes made it."""
        if len(state["generators"]) != self.processes.count:
            raise InputError(
                f"the interrupted run had {len(state['generators'])} processes, this one has "
                f"{self.processes.count}; go on with as many"
            )
        self.prior.denoiser.load_state_dict(state["denoiser"])
        self.prior.route_choice.load_state_dict(state["route_choice"])
        self.average = {key: value.to(self.device, copy=True) for key, value in state["average"].items()}
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = state["step"]
        self.generator.set_state(state["generators"][self.processes.rank].cpu())
