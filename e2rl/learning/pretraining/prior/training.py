"""Training the prior: steps on windows of logs, a moving average of the weights,
validation on held-out places."""

import math
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from e2rl.learning.logging import RunLogger
from e2rl.learning.pretraining.prior.loss import (
    CONSTANT_STD,
    MIN_STD,
    DenoisingLoss,
    augment,
    draw,
    held_out_loss,
    loss_weight,
)
from e2rl.learning.pretraining.prior.windows import STANDING_WEIGHT, make_windows
from e2rl.learning.pretraining.supervised import MAX_GRAD_NORM, Supervised
from e2rl.prior.checkpoint import save_prior
from e2rl.prior.denoiser import Denoiser
from e2rl.prior.prior import Prior
from e2rl.prior.routes import candidate_features, start_of
from e2rl.run.config import configured, setting
from e2rl.run.errors import InputError
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.run.terminal import Bar
from e2rl.scenes.scene import SceneSet

HELD_OUT = 8  # one in HELD_OUT places is held out for validation
WARM_UP = 50  # steps
WEIGHT_DECAY = 0.1
EMA = 0.998  # highest decay of the weights' average; first (1 + step) / (10 + step)
CAUSAL = 0.4  # fraction of windows whose start states are a causal observer's estimates
DROPOUT_SEED = 1_000_003  # difference of the dropout's seeds of consecutive steps


@configured("stage/prior")
@dataclass(frozen=True)
class TrainingSettings:
    """Settings of stage=prior; seed: the run's."""

    starts: tuple[int, ...] = setting(low=0)
    steps: int = setting(low=1)
    batch: int = setting(low=1)
    learning_rate: float = setting(low=0)
    bf16: bool | None = setting(optional=True)
    compile: bool = setting()
    route_steps: int = setting(low=0)
    validate_every: int = setting(low=1)
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.starts:
            raise InputError("stage.starts=[]: expected frame numbers, e.g. [10,30,50]")
        object.__setattr__(self, "starts", tuple(sorted(set(self.starts))))


class PriorTraining(Supervised):
    """The training of a prior: a turn is `validate_every` steps and a validation of the
    averaged weights.

    The held-out loss selects: thousands of windows at fixed noise make it precise.
    Closed-loop metrics on a few scenes would not: their noise exceeds the differences
    between turns.
    """

    def __init__(
        self,
        prior: Prior,
        windows: TensorDictBase,
        test: TensorDictBase,
        settings: TrainingSettings,
    ):
        """windows, test: to train on and held out."""
        super().__init__(settings)
        self.prior = prior
        self.windows = windows
        self.test = test
        self.done = 0
        self.routes: TensorDictBase | None = None  # scenes to train the route choice on
        self.accuracy = math.nan  # of the route choice
        self.device = next(prior.parameters()).device
        self.bf16 = has_bf16(self.device) if settings.bf16 is None else settings.bf16
        self.generator = torch.Generator(self.device).manual_seed(settings.seed)
        nodes = windows["nodes"][windows["present"]]
        std = nodes.std(0)
        prior.denoiser.node_mean.copy_(nodes.mean(0))
        prior.denoiser.node_std.copy_(
            torch.where(std < 1e-6, CONSTANT_STD, std.clamp(min=MIN_STD))
        )
        causal = windows["causal"]
        kinds = (causal.nonzero()[:, 0], (~causal).nonzero()[:, 0])
        self.rows = [rows for rows in kinds if len(rows)]
        loss: nn.Module = DenoisingLoss(prior.denoiser)
        self.loss = torch.compile(loss) if settings.compile else loss
        self.optimiser = torch.optim.AdamW(
            prior.denoiser.parameters(),
            settings.learning_rate,
            weight_decay=WEIGHT_DECAY,
            fused=True,
        )
        self.average = AveragedModel(prior.denoiser, multi_avg_fn=self._average)
        self.average.update_parameters(prior.denoiser)  # copies the initial weights

    def learning_rate(self) -> float:
        """Linear warm-up, then a cosine to 0."""
        settings = self.settings
        warm = min(1.0, (self.done + 1) / WARM_UP)
        cosine = 1 + math.cos(self.done / settings.steps * math.pi)
        return settings.learning_rate * warm * 0.5 * cosine

    def turn(self) -> dict[str, float]:
        """Steps up to the next validation, and that."""
        settings = self.settings
        if self.routes is not None and not self.done:
            self.accuracy = train_route_choice(
                self.prior,
                self.routes,
                settings=settings,
            )
        row = self.train(min(self.done + settings.validate_every, settings.steps))
        with self.averaged() as prior:
            loss = held_out_loss(prior, self.test, batch=settings.batch)
        return row | {"step": float(self.done), "held_out_loss": loss}

    def train(self, until: int) -> dict[str, float]:
        """Train up to step `until`; returns the running means of the loss's terms."""
        means: dict[str, float] = {}
        self.prior.train()
        bar = Bar(range(self.done, until), "steps", unit="step", leave=False)
        for _ in bar:
            batch = augment(self.windows[self.pick()].to(self.device), self.generator)
            terms = self.update(batch, draw(batch, self.generator))
            if self.done % 20 == 0:
                values = zip(("action", "trajectory"), terms.tolist(), strict=True)
                for name, value in values:
                    means[name] = 0.9 * means.get(name, value) + 0.1 * value
                bar.set_postfix({name: f"{value:.3f}" for name, value in means.items()})
        return means

    def pick(self) -> Tensor:
        """Indices [B] of a step's windows: a fraction CAUSAL of them with estimated
        starts, if both kinds exist."""
        uniform = torch.rand(
            2,
            self.settings.batch,
            generator=self.generator,
            device=self.device,
        ).to(self.rows[0].device)
        picks = [rows[(uniform[1] * len(rows)).long()] for rows in self.rows]
        return torch.where(uniform[0] < CAUSAL, picks[0], picks[-1])

    def update(self, batch: TensorDictBase, drawn: TensorDictBase) -> Tensor:
        """One step on windows with the random numbers of `loss.draw`;
        returns the loss's terms [2]."""
        # Dropout is seeded by step, so a resumed run repeats it.
        torch.manual_seed(self.settings.seed + DROPOUT_SEED * self.done)
        total = loss_weight(batch, drawn).sum().clamp(min=1)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16):
            loss, action, trajectory = self.loss(batch, drawn, total)
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate()
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.prior.denoiser.parameters(), MAX_GRAD_NORM)
        self.optimiser.step()
        self.done += 1
        self.average.update_parameters(self.prior.denoiser)
        return torch.stack([action, trajectory])

    def _average(
        self,
        average: Sequence[Tensor],
        current: Sequence[Tensor],
        _count: Tensor | int,
    ) -> None:
        """Exponential moving average whose decay grows to EMA with the steps (`_count`
        may be on the GPU)."""
        decay = min(EMA, (1 + self.done) / (10 + self.done))
        for mean, value in zip(average, current, strict=True):
            mean.lerp_(value, 1 - decay)

    @contextmanager
    def averaged(self) -> Iterator[Prior]:
        """Context in which the prior has the averaged weights and is in evaluation
        mode."""
        denoiser = self.prior.denoiser
        average = self.average.module
        assert isinstance(average, Denoiser)
        self.prior.denoiser = average
        self.prior.eval()
        try:
            yield self.prior
        finally:
            self.prior.denoiser = denoiser

    def weights(self) -> dict[str, Tensor]:
        """The averaged weights, on the CPU."""
        with self.averaged() as prior:
            return {key: value.cpu() for key, value in prior.state_dict().items()}

    def set_weights(self, weights: Mapping[str, Tensor]) -> None:
        self.prior.load_state_dict(weights)

    def state_dict(self) -> dict:
        """All that later turns depend on."""
        return {
            **super().state_dict(),
            "done": self.done,
            "accuracy": self.accuracy,
            "draws": self.generator.get_state().cpu(),
            **{name: part.state_dict() for name, part in self._stateful().items()},
        }

    def _stateful(self) -> dict[str, Any]:
        return {
            "denoiser": self.prior.denoiser,
            "route_choice": self.prior.route_choice,
            "average": self.average,
            "optimiser": self.optimiser,
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        super().load_state_dict(state)
        for name, part in self._stateful().items():
            part.load_state_dict(state[name])
        self.done = state["done"]
        self.accuracy = state["accuracy"]
        self.generator.set_state(state["draws"].cpu())


def has_bf16(device: torch.device) -> bool:
    """Whether the device computes in bf16; elsewhere it is emulated, on CPUs at a tenth
    of the speed of float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


def train_route_choice(
    prior: Prior,
    scenes: TensorDictBase,
    settings: TrainingSettings,
) -> float:
    """Train by cross-entropy on the driven candidate, over vehicles with several;
    returns the training accuracy."""
    device = next(prior.route_choice.parameters()).device
    features = torch.cat(
        [candidate_features(part, start_of(part)) for part in scenes.split(64)]
    )
    valid = scenes["route_valid"]
    label = scenes["route_log"]
    vehicles = slice(label.shape[1])
    use = scenes["valid"][:, vehicles] & ~scenes["parked"][:, vehicles] & (label >= 0)
    use &= valid.sum(-1) > 1
    features = features[use].to(device)
    valid = valid[use].to(device)
    label = label[use].to(device)
    if not len(label):
        return math.nan
    net = prior.route_choice.net
    generator = torch.Generator().manual_seed(settings.seed)
    optimiser = torch.optim.AdamW(
        prior.route_choice.parameters(),
        3e-3,
        weight_decay=0.05,
    )
    for _ in Bar(range(settings.route_steps), "route choice"):
        pick = torch.randint(len(label), (512,), generator=generator).to(device)
        sample = features[pick]
        noise = torch.randn(sample.shape, generator=generator).to(device)
        logits = net(sample + 0.05 * noise)[..., 0].masked_fill(~valid[pick], -1e4)
        loss = F.cross_entropy(logits, label[pick])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        logits = net(features)[..., 0].masked_fill(~valid, -torch.inf)
    return (logits.argmax(-1) == label).float().mean().item()


def held_out(scenes: SceneSet) -> Tensor:
    """[S] bool: scenes of held-out places (without places: of held-out logs). Raises
    InputError if all are."""
    places = [
        location or scene_id.split("@")[0]
        for location, scene_id in zip(scenes.location, scenes.scene_id, strict=True)
    ]
    chosen = set(sorted(set(places))[::HELD_OUT])
    mask = torch.tensor([place in chosen for place in places])
    if bool(mask.all()):
        raise InputError(
            f"all {len(scenes)} scenes are of one place ({places[0]!r}), so none can be "
            "held out for validation; train on logs of several places"
        )
    return mask


def windows_of(scenes: SceneSet, rows: Tensor, kind: str) -> TensorDictBase:
    """Windows of scenes rows [S] bool. Raises InputError, which names their kind, if
    there are none or no vehicle moves."""
    windows = make_windows(scenes.batch(rows.nonzero()[:, 0]))
    if not len(windows):
        raise InputError(
            f"no {kind} windows in {len(scenes)} scenes: too few vehicles are recorded "
            "for a second on a known route; train on more or longer logs"
        )
    if not bool((windows["weight"] > STANDING_WEIGHT).any()):
        raise InputError(
            f"no vehicle moves in the {len(windows)} {kind} windows of {len(scenes)} "
            "scenes; train on logs with moving traffic"
        )
    return windows


def train_prior(
    prior: Prior,
    scenes: SceneSet,
    *,
    settings: TrainingSettings,
    folder: Path,
    origin: dict,
    logger: RunLogger | None = None,
    parts: Parts = NO_PARTS,
) -> Path:
    """Train a prior; returns the path of its checkpoint.

    Args:
        prior: that is trained, in place.
        scenes: to train on; some of their places are held out.
        settings: of the training.
        folder: for the checkpoint, which has the averaged weights of the lowest
            held-out loss.
        origin: data and command, for the checkpoint's header, which also has the
            results of the training.
        logger: of the losses.
        parts: of the run, from which an interrupted training goes on exactly.

    Raises:
        InputError: too few scenes.
    """
    begin = time.perf_counter()
    validation = held_out(scenes)
    windows = windows_of(scenes, ~validation, "training")
    test = windows_of(scenes, validation, "held-out")
    run = PriorTraining(prior, windows, test=test, settings=settings)
    run.routes = scenes.batch((~validation).nonzero()[:, 0])
    turns = -(-settings.steps // settings.validate_every)
    best = run.fit("prior", turns, parts, logger=logger)
    results = {
        "windows": len(windows),
        "held_out_windows": len(test),
        "validation": best,
        "held_out_loss": best["held_out_loss"],
        "step": int(best["step"]),
        "route_accuracy": run.accuracy,
        "device": str(run.device),
        "versions": {"python": platform.python_version(), "torch": torch.__version__},
        "seconds": {"training": round(time.perf_counter() - begin, 1)},
    }
    return save_prior(prior.eval(), folder, origin=origin | results)
