"""Expert pairs (observation, action) from recordings, and the actor's warm start from them.

Recorded pairs come in two kinds. Replayed: the ego follows its log exactly and the action is the inverse unicycle's.
Disturbed: the ego tracks its log while its actions are perturbed for a second at a time (Laskey et al. 2017), so the
pairs show recoveries; the label is the undisturbed action.

During cloning, noise is added to the network's input, most to the last executed action: actions are strongly
autocorrelated, so the actor would copy it instead of learning its causes (de Haan et al. 2019).
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from tqdm import tqdm

from e2rl.learning.cloning import cloning_loss, pairs_of
from e2rl.learning.driving import Disturbance, PoolDriver, filled_batches
from e2rl.learning.logging import RunLogger
from e2rl.learning.run_checkpoint import generator_states, restore_generators
from e2rl.learning.update import take_step
from e2rl.planners.log_replay import ReplayEgo
from e2rl.planners.network import WEIGHTS, ActorCritic
from e2rl.run.errors import InputError
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import SimSettings
from e2rl.traffic.pool import TrafficPool

STATE, PROGRESS = "epochs", ("history", "best", "chosen")  # a part of the run; what it holds of a training
BURST, PAUSE = 10, 20  # steps: duration of a disturbance, and from the start of one to the next


@dataclass(frozen=True)
class ImitationSettings:
    """Fields: `imitation` in conf/learner/ppo_bc.yaml."""

    epochs: int = 8
    minibatch: int = 512
    learning_rate: float = 3e-4
    weight_decay: float = 1e-2
    max_grad_norm: float = 1.0
    held_out: float = 0.1
    drives: int = 3
    disturbed_acceleration: float = 1.0
    disturbed_yaw_rate: float = 0.15
    feature_noise: float = 0.3
    last_action_noise: float = 1.0
    batch: int = 64
    seed: int = 0


def recorded_pairs(scenes: SceneSet, sim: SimSettings, settings: ImitationSettings) -> TensorDict:
    """Pairs [M] with C = 1 (e2rl.learning.cloning) of every recording, replayed once and disturbed `drives` times.

    A disturbed episode counts until contact or off the road; actions are clipped to 0.99 of the bounds.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    pool, parts = TrafficPool.recorded(torch.arange(len(scenes))), []
    batch = min(settings.batch, len(scenes))
    exact = PoolDriver(scenes, replace(sim, replay_ego=True, end_on_contact=False, end_off_road=False), batch)
    free = PoolDriver(scenes, replace(sim, replay_ego=False), batch)
    todo = [(rows, number) for number in range(settings.drives + 1) for rows in filled_batches(len(pool), batch)]
    for rows, number in tqdm(todo, "expert pairs", unit="batch", leave=False, disable=None):
        driver, label, disturb = (
            (exact, "executed", None) if number == 0 else (free, "intended", _bursts(len(rows), settings, generator))
        )
        frames = driver.drive(ReplayEgo(), pool, rows, disturb)
        action = frames[label][:, :, None]
        parts.append(pairs_of(frames, frames["alive"], pool.scene_index[rows], driver.env, action))
    return torch.cat(parts)


def _bursts(batch: int, settings: ImitationSettings, generator: torch.Generator) -> Disturbance:
    """Constant offsets of random size for BURST steps out of every PAUSE, at a random phase per scene."""
    size = torch.tensor([settings.disturbed_acceleration, settings.disturbed_yaw_rate])
    offsets = torch.randn(batch, 100, 2, generator=generator) * size
    phase = torch.randint(PAUSE, (batch,), generator=generator)

    def disturb(action: Tensor, step: Tensor) -> Tensor:
        since = step.cpu() + phase
        offset = offsets[torch.arange(batch), since // PAUSE] * (since % PAUSE < BURST)[:, None]
        return action + offset.to(action.device)

    return disturb


class Imitation:
    """Behaviour cloning of an ActorCritic's actor from pairs, with held-out scenes.

    history: one row per epoch; best, chosen: the row and the weights of the epoch of the lowest held-out loss.
    """

    def __init__(self, network: ActorCritic, pairs: TensorDictBase, settings: ImitationSettings) -> None:
        self.network, self.settings = network, settings
        self.history: list[dict[str, float]] = []
        self.best: dict[str, float] | None = None
        self.chosen: dict[str, Tensor] = {}
        self._generator = torch.Generator().manual_seed(settings.seed)
        scenes = pairs["scene_index"].unique()
        scenes = scenes[torch.randperm(len(scenes), generator=self._generator)]
        apart = scenes[: max(round(settings.held_out * len(scenes)), int(settings.held_out > 0))]
        held_out = torch.isin(pairs["scene_index"], apart)
        pairs = pairs.select("observation", "action", "weight").to(network.device)
        self.train, self.held_out = pairs[~held_out.to(pairs.device)], pairs[held_out.to(pairs.device)]
        self.optimiser = torch.optim.AdamW(
            network.network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
        )
        network.normaliser.observe(self.train["observation"])

    @torch.no_grad()
    def measure(self, pairs: TensorDictBase) -> tuple[float, float]:
        """The cloning loss of pairs, and the mean distance of the deterministic action from the labels as a share of
        half the range; NaN without pairs."""
        if not len(pairs):
            return float("nan"), float("nan")
        loss = cloning_loss(self.network.actor, pairs).item()
        reach = (self.network.high - self.network.low) / 2
        central = self.network.network.deterministic(pairs["observation"])
        miss = ((central[:, None] - pairs["action"]).abs() / reach).mean(-1)
        return loss, (miss * pairs["weight"]).sum(1).mean().item()

    def epoch(self) -> dict[str, float]:
        """One pass over the training pairs; returns training and held-out losses."""
        order = torch.randperm(len(self.train), generator=self._generator).to(self.network.device)
        settings = self.settings
        for index in order.split(settings.minibatch):
            with self.network.network.noisy(settings.feature_noise, settings.last_action_noise):
                loss = cloning_loss(self.network.actor, self.train[index])
            take_step(self.optimiser, loss, settings.max_grad_norm)
        (fit, miss), (held_fit, held_miss) = self.measure(self.train), self.measure(self.held_out)
        row = {"loss": fit, "miss": miss, "held_out_loss": held_fit, "held_out_miss": held_miss}
        if self.best is None or not row["held_out_loss"] >= self.best["held_out_loss"]:
            self.best = row | {"epoch": float(len(self.history))}
            self.chosen = {key: value.clone() for key, value in self.network.weights().items()}
        self.history.append(row)
        return row

    def state_dict(self) -> dict:
        """All that later epochs depend on, the global generators included."""
        return {
            "weights": dict(self.network.weights()),
            "optimiser": self.optimiser.state_dict(),
            "generators": {"own": self._generator.get_state(), "global": generator_states()},
            **{name: getattr(self, name) for name in PROGRESS},
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        self.network.set_weights(state["weights"])
        self.optimiser.load_state_dict(state["optimiser"])
        self._generator.set_state(state["generators"]["own"])
        restore_generators(state["generators"]["global"])
        for name in PROGRESS:
            setattr(self, name, state[name])


def imitate(
    network: ActorCritic,
    pairs: TensorDictBase,
    settings: ImitationSettings,
    folder: Path | None = None,
    logger: RunLogger | None = None,
    kept: Parts = NO_PARTS,
) -> dict[str, float]:
    """Clone the pairs for settings.epochs and choose the weights of the lowest held-out loss (of the last epoch if no
    scene is held out). Improved weights are written to folder / WEIGHTS; returns the row of the chosen epoch. kept: the
    state after each epoch."""
    run, begin = Imitation(network, pairs, settings), 0
    if (state := kept.load(STATE, vars(settings))) is not None:
        run.load_state_dict(state)
        begin = len(run.history)
    if logger is not None:
        logger.forget(begin)
    for epoch in (bar := tqdm(range(begin, settings.epochs), "imitation", unit="epoch", disable=None)):
        row = run.epoch()
        bar.set_postfix({name: f"{value:.3f}" for name, value in row.items()})
        if logger is not None:
            logger.log({f"train/imitation_{name}": value for name, value in row.items()}, epoch)
        if folder is not None and run.best is not None and run.best["epoch"] == epoch:
            network.save(Path(folder) / WEIGHTS)
        kept.save(STATE, vars(settings), run.state_dict())
    if run.best is None:
        raise InputError(f"learner.imitation.epochs={settings.epochs}: at least one epoch")
    network.set_weights(run.chosen)
    return run.best
