"""Supervised training for the stages imitation, bits and prior: turns of optimiser
steps, each followed by a validation; the weights of the lowest held-out loss are
chosen; an interrupted training goes on exactly."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor, nn

from e2rl.learning.generators import generator_states, restore_generators
from e2rl.learning.logging import RunLogger
from e2rl.run.config import Settings, resolved, setting, settings_of
from e2rl.run.cpu import onednn_products
from e2rl.run.errors import InputError
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.run.terminal import Bar

STATE = "turns"  # a part of the run
PROGRESS = ("history", "best", "chosen")  # what it holds of a training
MAX_GRAD_NORM = 1.0


def stage_settings(config: DictConfig, kind: type[Settings]) -> Settings:
    """Returns the settings of the stage that a configuration has chosen, with the run's
    seed."""
    options = resolved(config.stage) | {"seed": config.seed}
    del options["name"]
    return settings_of(kind, options, where="stage")


@dataclass(frozen=True, kw_only=True)
class EpochSettings:
    """Settings of a stage in passes over its data; seed: the run's."""

    epochs: int = setting(low=1)
    minibatch: int = setting(low=1)
    learning_rate: float = setting(low=0)
    held_out: float = setting(low=0, high=0.9)
    seed: int = 0


class Supervised(ABC):
    """A training in turns. A subclass defines `turn`, and its own part of the state.

    history: one row a turn; best: the row of the turn with the lowest held-out loss, of
    the last one where nothing is held out; chosen: the weights after it.
    """

    def __init__(self, settings: Any) -> None:
        """settings: a dataclass of plain values."""
        self.settings = settings
        self.history: list[dict[str, float]] = []
        self.best: dict[str, float] = {}
        self.chosen: dict[str, Tensor] = {}

    @abstractmethod
    def turn(self) -> dict[str, float]:
        """Train for a turn; returns losses, `held_out_loss` among them (NaN: nothing is
        held out)."""

    @abstractmethod
    def weights(self) -> dict[str, Tensor]:
        """The weights that a validation measures."""

    @abstractmethod
    def set_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Take weights that were chosen."""

    def fit(
        self,
        name: str,
        turns: int,
        parts: Parts = NO_PARTS,
        *,
        logger: RunLogger | None = None,
    ) -> dict[str, float]:
        """Do the turns that are missing and take the chosen weights; returns the row of
        their turn.

        Args:
            name: of the training.
            turns: of the whole training.
            parts: where the state after each turn is kept, of the same settings.
            logger: of the rows of the turns, as train/NAME_...
        """
        about = vars(self.settings)
        if (state := parts.load(STATE, about)) is not None:
            self.load_state_dict(state)
        first = len(self.history)
        if logger is not None:
            logger.forget(first)
        bar = Bar(range(first, turns), name, turns, initial=first, unit="turn")
        for number in bar:
            row = self.turn()
            if not self.best or not row["held_out_loss"] >= self.best["held_out_loss"]:
                self.best = row | {"turn": float(number)}
                self.chosen = {
                    key: value.detach().clone() for key, value in self.weights().items()
                }
            self.history.append(row)
            bar.set_postfix({key: f"{value:.3f}" for key, value in row.items()})
            parts.save(STATE, about, self.state_dict())
            if logger is not None:
                logger.log(
                    {f"train/{name}_{key}": value for key, value in row.items()},
                    number,
                )
        self.set_weights(self.chosen)
        return self.best

    def state_dict(self) -> dict:
        """All that later turns depend on, the global generators included."""
        return {
            "generators": generator_states(),
            **{name: getattr(self, name) for name in PROGRESS},
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        restore_generators(state["generators"])
        for name in PROGRESS:
            setattr(self, name, state[name])


class Epochs(Supervised):
    """Turns are passes over rows [M] of `data` in random order; scenes are held out by
    `scene_index` [M]."""

    def __init__(
        self,
        network: Any,
        data: TensorDictBase,
        settings: EpochSettings,
        parameters: nn.Module,
        weight_decay: float,
    ) -> None:
        """network: with `device` and `normaliser`; parameters: the module whose
        parameters are trained. Raises InputError where no scene is left to train on."""
        super().__init__(settings)
        self.network = network
        self._generator = torch.Generator().manual_seed(settings.seed)
        scenes = data["scene_index"].unique()
        scenes = scenes[torch.randperm(len(scenes), generator=self._generator)]
        count = max(round(settings.held_out * len(scenes)), int(settings.held_out > 0))
        if count == len(scenes):
            reason = (
                "of one scene none can be held out"
                if count == 1
                else "no scene is left to train on"
            )
            raise InputError(
                f"stage.held_out={settings.held_out:g}: {reason}; "
                "pass more, or set it to 0"
            )
        held_out = torch.isin(data["scene_index"], scenes[:count])
        self.train = data[~held_out].to(network.device)
        self.held_out = data[held_out].to(network.device)
        network.normaliser.observe(self.train["observation"])
        self.optimiser = torch.optim.AdamW(
            parameters.parameters(),
            settings.learning_rate,
            weight_decay=weight_decay,
        )

    @abstractmethod
    def loss(self, batch: TensorDictBase) -> Tensor:
        """The loss [] of a minibatch, as it is trained on."""

    @abstractmethod
    def measure(self, data: TensorDictBase) -> dict[str, float]:
        """The mean losses of data, which has rows, `loss` among them."""

    @onednn_products()
    def turn(self) -> dict[str, float]:
        """One pass over the training rows; returns the mean of its losses, and the
        held-out ones."""
        order = torch.randperm(len(self.train), generator=self._generator)
        losses = []
        for rows in order.to(self.train.device).split(self.settings.minibatch):
            loss = self.loss(self.train[rows])
            self.step(loss)
            losses.append(loss.detach())
        row = {"loss": torch.stack(losses).mean().item(), "held_out_loss": math.nan}
        if len(self.held_out):
            for name, value in self.measure(self.held_out).items():
                row[f"held_out_{name}"] = value
        return row

    def step(self, loss: Tensor) -> None:
        """One step of the optimiser."""
        take_step(self.optimiser, loss, max_grad_norm=MAX_GRAD_NORM)

    def state_dict(self) -> dict:
        return super().state_dict() | {
            "optimiser": self.optimiser.state_dict(),
            "order": self._generator.get_state(),
            "weights": self.weights(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        super().load_state_dict(state)
        self.set_weights(state["weights"])
        self.optimiser.load_state_dict(state["optimiser"])
        self._generator.set_state(state["order"])


def take_step(
    optimiser: torch.optim.Optimizer,
    loss: Tensor,
    max_grad_norm: float,
) -> None:
    """One step down the gradient of `loss`, its norm clipped; raises InputError if the
    loss is not finite."""
    if not torch.isfinite(loss):
        raise InputError(
            "learner: the loss is not finite; "
            "lower the learning_rate or check the observations"
        )
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    parameters = [
        value for group in optimiser.param_groups for value in group["params"]
    ]
    torch.nn.utils.clip_grad_norm_(parameters, max_grad_norm)
    optimiser.step()
