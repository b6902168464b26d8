"""Optimisation of the denoiser: training state, steps, moving average of the weights, exact resume."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from tqdm import tqdm

from e2rl.learning.prior_training.distributed import ALONE, Processes
from e2rl.learning.prior_training.loss import CONSTANT_STD, MIN_STD, DenoisingLoss, augment, draw, loss_weight
from e2rl.learning.prior_training.training_settings import TrainingSettings
from e2rl.prior.denoiser import Denoiser
from e2rl.prior.prior import Prior
from e2rl.run.errors import InputError

WARM_UP = 50  # steps
RANK_SEED = 1_000_003  # difference of the generator seeds of consecutive ranks


def has_bf16(device: torch.device) -> bool:
    """Whether the device computes in bf16; elsewhere it is emulated, on CPUs at a tenth of the speed of float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


class PriorTraining:
    """The state of one training run: network, moving average of its weights, optimiser, progress and generator.

    Each process draws its share of a step's windows and noise; gradients are averaged. Hence weights and moving
    averages are equal in all processes, and a run is determined by its seed and the number of processes.
    """

    def __init__(self, prior: Prior, windows: TensorDictBase, settings: TrainingSettings, processes: Processes = ALONE):
        """Raises InputError if the processes cannot share a batch evenly."""
        if settings.batch % processes.count:
            text = f"prior.training.batch={settings.batch}: {processes.count} processes share the windows of a step"
            raise InputError(f"{text} evenly; choose a multiple of their number")
        self.prior, self.windows, self.settings, self.processes = prior, windows, settings, processes
        self.step, self.share = 0, settings.batch // processes.count
        self.device = next(prior.parameters()).device
        self.bf16 = has_bf16(self.device) if settings.bf16 is None else settings.bf16
        self.generator = torch.Generator(self.device).manual_seed(settings.seed + RANK_SEED * processes.rank)
        nodes, causal = windows["nodes"][windows["present"]], windows["causal"]
        std = nodes.std(0)
        prior.denoiser.node_mean.copy_(nodes.mean(0))
        prior.denoiser.node_std.copy_(torch.where(std < 1e-6, CONSTANT_STD, std.clamp(min=MIN_STD)))
        self.rows = [rows for rows in (causal.nonzero()[:, 0], (~causal).nonzero()[:, 0]) if len(rows)]
        processes.share(prior.denoiser)
        loss = DenoisingLoss(prior.denoiser, settings)
        self.loss = torch.compile(loss) if settings.compile else loss
        self.optimiser = torch.optim.AdamW(
            prior.denoiser.parameters(), settings.learning_rate, weight_decay=settings.weight_decay, fused=True
        )
        self.average = AveragedModel(prior.denoiser, multi_avg_fn=self._average)
        self.average.update_parameters(prior.denoiser)  # the first call copies the initial weights

    def learning_rate(self) -> float:
        """Linear warm-up, then a cosine to 0."""
        warm = min(1.0, (self.step + 1) / WARM_UP)
        return self.settings.learning_rate * warm * 0.5 * (1 + math.cos(self.step / self.settings.steps * math.pi))

    def run(self, until: int) -> dict[str, float]:
        """Train up to step `until`; returns the running means of the loss's terms."""
        running: dict[str, float] = {}
        self.prior.train()
        bar = tqdm(
            range(self.step, until), "prior", initial=self.step, total=self.settings.steps, unit="step", disable=None
        )
        for _ in bar:
            batch = augment(self.windows[self.pick()].to(self.device), self.settings, self.generator)
            terms = self.update(batch, draw(batch, self.settings, self.generator))
            if self.step % 20 == 0:
                for key, value in zip(("action", "trajectory"), self.processes.mean(terms).tolist(), strict=True):
                    running[key] = 0.9 * running.get(key, value) + 0.1 * value
                bar.set_postfix({key: f"{value:.3f}" for key, value in running.items()})
        return running

    def pick(self) -> Tensor:
        """Indices [share] of a step's windows: a share `causal` of them with estimated starts, if both kinds exist."""
        uniform = torch.rand(2, self.share, generator=self.generator, device=self.device).to(self.rows[0].device)
        picks = [rows[(uniform[1] * len(rows)).long()] for rows in self.rows]
        return torch.where(uniform[0] < self.settings.causal, picks[0], picks[-1])

    def update(self, batch: TensorDictBase, drawn: TensorDictBase) -> Tensor:
        """One step on this process's windows with the random numbers of `loss.draw`; returns the loss's terms [2]."""
        # Dropout is seeded by step and rank, so a resumed run repeats it.
        torch.manual_seed(self.settings.seed + RANK_SEED * (self.step * self.processes.count + self.processes.rank))
        total = self.processes.mean(loss_weight(batch, drawn).sum()).clamp(min=1)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16):
            loss, action, trajectory = self.loss(batch, drawn, total)
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate()
        self.optimiser.zero_grad()
        loss.backward()
        self.processes.average_gradients(self.prior.denoiser)
        torch.nn.utils.clip_grad_norm_(self.prior.denoiser.parameters(), 1.0)
        self.optimiser.step()
        self.step += 1
        self.average.update_parameters(self.prior.denoiser)
        return torch.stack([action, trajectory])

    def _average(self, average: Sequence[Tensor], current: Sequence[Tensor], _count: Tensor | int) -> None:
        """Exponential moving average whose decay grows to `ema` with self.step (`_count` may be on the GPU)."""
        decay = min(self.settings.ema, (1 + self.step) / (10 + self.step))
        for mean, value in zip(average, current, strict=True):
            mean.lerp_(value, 1 - decay)

    @contextmanager
    def averaged(self) -> Iterator[Prior]:
        """Context in which the prior has the averaged weights and is in evaluation mode."""
        denoiser, average = self.prior.denoiser, self.average.module
        assert isinstance(average, Denoiser)
        self.prior.denoiser = average
        self.prior.eval()
        try:
            yield self.prior
        finally:
            self.prior.denoiser = denoiser

    def state_dict(self) -> dict:
        """All state for exact resumption. Collective: all processes must call it."""
        return {
            "denoiser": self.prior.denoiser.state_dict(),
            "route_choice": self.prior.route_choice.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "generators": self.processes.gather(self.generator.get_state().cpu()),
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`. Raises InputError if the number of processes differs."""
        count, generators = self.processes.count, state["generators"]
        if len(generators) != count:
            raise InputError(
                f"the interrupted run had {len(generators)} processes, this one has {count}; resume with as many"
            )
        self.prior.denoiser.load_state_dict(state["denoiser"])
        self.prior.route_choice.load_state_dict(state["route_choice"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = state["step"]
        self.generator.set_state(generators[self.processes.rank].cpu())
