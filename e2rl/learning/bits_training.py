"""Training of the ego `bits` on recordings: every moving vehicle of a scene plays the ego, along its own route.

A window is a vehicle at a frame and its next 5 s. Where they end is the goal. The goal head learns it by cross-entropy;
the policy, told the goal, learns the way there through the unicycle. Half of the windows begin beside the recording, so
that the policy learns to come back.
"""

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from tqdm import tqdm

from e2rl.learning.update import take_step
from e2rl.planners.bits import observed
from e2rl.planners.bits_network import WEIGHTS, BitsNetwork, cell_of, drive_controls, save_bits
from e2rl.planners.ego import PLAN_STEPS
from e2rl.planners.path import RoutePath
from e2rl.planners.reference import LAST_ACTION
from e2rl.run.errors import InputError
from e2rl.run.settings import check_range
from e2rl.scenes.recording import DT
from e2rl.scenes.route import project
from e2rl.scenes.scene import SceneSet
from e2rl.sim.dynamics import wrap
from e2rl.sim.mission import mission_of
from e2rl.sim.world import World

AGENT_KEYS = ("start", "start_accel", "start_yaw_rate", "valid", "size", "agent_type")  # one row an agent
LOG_KEYS = ("logged", "logged_valid")  # one column an agent
ROUTE_KEYS = ("points", "length", "open", "limit", "light", "light_s")  # of "route_...", by vehicle
MAP_KEYS = ("light_state", "field", "field_origin")
CHUNK = 64  # windows that are made at once
MOVES = 2.0  # m that a vehicle moves in the recording, at least
FARTHEST = 6.0  # m beside its route from which on a vehicle does not follow it


@dataclass(frozen=True)
class BitsSettings:
    """Fields: `bits` in conf/train.yaml; seed: the run's. Raises InputError for a value out of range."""

    hidden: int = 64
    dropout: float = 0.2
    epochs: int = 20
    minibatch: int = 256
    learning_rate: float = 1e-3
    weight_decay: float = 0.1
    max_grad_norm: float = 1.0
    held_out: float = 0.1
    every: int = 5
    aside: float = 0.5
    turned: float = 0.06
    faster: float = 1.0
    feature_noise: float = 0.5
    last_action_noise: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("hidden", "epochs", "minibatch", "every"):
            check_range(f"bits.{name}", getattr(self, name), low=1)
        for name in ("learning_rate", "weight_decay", "max_grad_norm", "aside", "turned", "faster"):
            check_range(f"bits.{name}", getattr(self, name), low=0)
        for name in ("feature_noise", "last_action_noise"):
            check_range(f"bits.{name}", getattr(self, name), low=0)
        for name in ("held_out", "dropout"):
            check_range(f"bits.{name}", getattr(self, name), low=0, high=0.9)


# --- windows


def as_ego(scenes: TensorDictBase, scene: Tensor, vehicle: Tensor) -> TensorDict:
    """Scenes `scene` [W] in which vehicle [W] and the ego have changed places, with no other vehicle's route: what a
    `BitsEgo` reads."""
    row = torch.arange(len(scene))
    order = torch.arange(scenes["valid"].shape[1]).repeat(len(scene), 1)
    order[row, vehicle], order[:, 0] = 0, vehicle
    out = {key: scenes[key][scene[:, None], order] for key in AGENT_KEYS}
    out |= {key: scenes[key][scene].transpose(1, 2)[row[:, None], order].transpose(1, 2) for key in LOG_KEYS}
    out |= {key: scenes[key][scene] for key in MAP_KEYS}
    pick = scenes["route_log"][scene, vehicle]
    out |= {f"route_{key}": scenes[f"route_{key}"][scene, vehicle, pick][:, None, None] for key in ROUTE_KEYS}
    return TensorDict(out | {"route_log": torch.zeros_like(pick)[:, None]}, batch_size=[len(scene)])


def world_at(scene: TensorDictBase, step: int) -> World:
    """The Worlds of recorded scenes [W] at a step: as estimated at the start frame, later as recorded."""
    if step == 0:
        return World.at_start(scene)
    now, before = scene["logged"][:, step], scene["logged"][:, step - 1]
    valid = scene["logged_valid"][:, step]
    change = torch.where((valid & scene["logged_valid"][:, step - 1])[..., None], now - before, 0.0) / DT
    turn = wrap(change[..., 2] * DT) / DT
    steps = torch.full((len(now),), step)
    return World(scene, steps, now, valid, change[..., 3], turn_rate=turn)


def windows(scenes: SceneSet, settings: BitsSettings) -> TensorDict:
    """Windows [W] of all moving vehicles: observation [D], start [4], route [P, 2], future [PLAN_STEPS, 4], way and
    side: the goal, scene_index. Raises InputError where there are none."""
    every, generator = scenes.scenes, torch.Generator().manual_seed(settings.seed)
    vehicles = every["route_log"].shape[1]
    logged = every["logged"][:, :, :vehicles, :2]
    moved = (logged - logged[:, :1]).norm(dim=-1).masked_fill(~every["logged_valid"][:, :, :vehicles], 0).amax(1)
    moving = every["valid"][:, :vehicles] & ~every["parked"][:, :vehicles] & (every["route_log"] >= 0)
    rows, parts = (moving & (moved > MOVES)).nonzero(), []
    for scene, vehicle in tqdm([part.unbind(1) for part in rows.split(CHUNK) if len(part)], "windows", disable=None):
        own = as_ego(every, scene, vehicle)
        for step in range(0, own["logged"].shape[1] - PLAN_STEPS, settings.every):
            exact = world_at(own, step)
            parts += [_windows(world, scene) for world in (exact, _disturbed(exact, settings, generator))]
    found = torch.cat(parts) if parts else TensorDict({}, [0])
    if not len(found):
        raise InputError(f"{scenes.dataset}: no vehicle moves and is recorded for {PLAN_STEPS * DT:g} s; pass others")
    return found


def _disturbed(world: World, settings: BitsSettings, generator: torch.Generator) -> World:
    """Worlds whose egos are beside their recording, turned, and faster or slower; who stands stays."""
    size = torch.tensor([settings.aside, settings.turned, settings.faster])
    aside, turned, faster = (torch.randn(len(world.step), 3, generator=generator) * size).unbind(1)
    states = world.states.clone()
    x, y, heading, speed = states[:, 0].unbind(-1)
    share = (speed / 5).clamp(max=1)
    moved = [x - aside * share * heading.sin(), y + aside * share * heading.cos(), wrap(heading + turned * share)]
    states[:, 0] = torch.stack([*moved, (speed + faster * share).clamp(min=0)], -1)
    return replace(world, states=states)


def _windows(world: World, scene: Tensor) -> TensorDict:
    """Windows of Worlds [B], without those whose ego's next 5 s are not recorded or lead away from its route."""
    step, route = int(world.step[0]), mission_of(world.scene).points
    ahead = slice(step + 1, step + 1 + PLAN_STEPS)
    future, known = world.scene["logged"][:, ahead, 0], world.scene["logged_valid"][:, step : ahead.stop, 0].all(1)
    path = RoutePath(world.states[:, 0], route)
    hint = path.s + (future[..., 3] * DT).sum(1)
    end, side, _ = (value[:, 0] for value in project(future[:, -1:, :2], route, hint[:, None]))
    columns = {"observation": observed(world), "start": world.states[:, 0], "route": route, "future": future}
    columns |= {"way": (end - path.s).clamp(min=0), "side": side, "scene_index": scene}
    kept = known & world.valid[:, 0] & (torch.maximum(side.abs(), path.d.abs()) < FARTHEST)
    return TensorDict(columns, batch_size=[len(scene)])[kept]


# --- training


def losses(network: BitsNetwork, batch: TensorDictBase, noise: Tensor | None = None) -> dict[str, Tensor]:
    """Mean losses of windows [W]: goal (cross-entropy of the recorded goal's cell, nats), residual (of the place in it,
    cells), trajectory (distance from the recording of the plan to that goal, mean over the 5 s, m)."""
    start, way, side = batch["start"], batch["way"], batch["side"]
    path, code = RoutePath(start, batch["route"]), network.encode(batch["observation"], noise)
    cell, residual = cell_of(start[:, 3], way, side)
    logits, residuals = network.goals(code)
    guessed = residuals.gather(1, cell[:, None, None].expand(-1, 1, 2))[:, 0]
    controls = network.controls(code, start[:, 3], path.d, way[:, None], side[:, None])
    states = drive_controls(controls, start, path).states[:, 0]
    gap = (states[..., :2] - batch["future"][..., :2]).square().sum(-1)
    return {
        "goal": F.cross_entropy(logits, cell),
        "residual": F.smooth_l1_loss(guessed, residual),
        "trajectory": ((gap + 0.01).sqrt() - 0.1).mean(),
    }


class BitsTraining:
    """Imitation by a BitsNetwork of windows, with held-out scenes. `history`: one row an epoch."""

    def __init__(self, network: BitsNetwork, data: TensorDictBase, settings: BitsSettings) -> None:
        self.network, self.settings = network, settings
        self.history: list[dict[str, float]] = []
        self._generator = torch.Generator().manual_seed(settings.seed)
        scenes = data["scene_index"].unique()
        scenes = scenes[torch.randperm(len(scenes), generator=self._generator)]
        count = max(round(settings.held_out * len(scenes)), int(settings.held_out > 0))
        if count == len(scenes):
            raise InputError(
                f"bits.held_out={settings.held_out:g}: of one scene none can be held out; pass more, or set it to 0"
            )
        apart = torch.isin(data["scene_index"], scenes[:count])
        self.train, self.held_out = (data[rows].to(network.device) for rows in (~apart, apart))
        network.normaliser.observe(self.train["observation"])
        self.optimiser = torch.optim.AdamW(
            network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
        )
        total = settings.epochs * -(-len(self.train) // settings.minibatch)
        self.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(self.optimiser, total)
        self.noise = torch.full_like(network.normaliser.mean, settings.feature_noise)
        self.noise[list(LAST_ACTION)] = settings.last_action_noise

    @torch.no_grad()
    def measure(self, data: TensorDictBase) -> dict[str, float]:
        """The losses of windows and their sum `loss`; NaN without windows."""
        if not len(data):
            return dict.fromkeys(("goal", "residual", "trajectory", "loss"), float("nan"))
        self.network.eval()
        rows = [(len(part), losses(self.network, part)) for part in data.split(4096)]
        mean = {name: float(sum(count * row[name] for count, row in rows)) / len(data) for name in rows[0][1]}
        return mean | {"loss": sum(mean.values())}

    def epoch(self) -> dict[str, float]:
        """One pass over the training windows; returns its mean losses and the held-out ones."""
        self.network.train()
        seen: list[Tensor] = []
        for batch in self._batches():
            parts = losses(self.network, batch, self.noise * torch.randn_like(batch["observation"]))
            loss = torch.stack(list(parts.values())).sum()
            take_step(self.optimiser, loss, self.settings.max_grad_norm)
            self.schedule.step()
            seen.append(loss.detach())
        row = {"loss": torch.stack(seen).mean().item()}
        row |= {f"held_out_{name}": value for name, value in self.measure(self.held_out).items()}
        self.history.append(row)
        return row

    def _batches(self) -> Iterator[TensorDictBase]:
        order = torch.randperm(len(self.train), generator=self._generator).to(self.network.device)
        return (self.train[index] for index in order.split(self.settings.minibatch))


def train_bits(
    network: BitsNetwork,
    scenes: SceneSet,
    settings: BitsSettings,
    folder: Path,
    origin: dict[str, Any],
    log: Callable[[dict[str, float], int], None] | None = None,
) -> dict[str, float]:
    """Train a network, in place, and keep the weights of the lowest held-out loss (of the last epoch if no scene is
    held out), written to folder / WEIGHTS. Returns the row of the epoch kept."""
    data = windows(scenes, settings)
    run, best, kept = BitsTraining(network, data, settings), None, None
    for epoch in (bar := tqdm(range(settings.epochs), "bits", unit="epoch", disable=None)):
        row = run.epoch()
        bar.set_postfix({name: f"{value:.3f}" for name, value in row.items()})
        if log is not None:
            log({f"train/bits_{name}": value for name, value in row.items()}, epoch)
        if best is None or not row["held_out_loss"] >= best["held_out_loss"]:
            best, kept = row | {"epoch": float(epoch)}, deepcopy(network.state_dict())
    assert best is not None and kept is not None
    network.load_state_dict(kept)
    result = {"windows": len(data), "settings": asdict(settings), "result": best}
    save_bits(network, Path(folder) / WEIGHTS, origin | result)
    return best
