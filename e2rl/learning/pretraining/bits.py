"""Training of the ego `bits` on recordings: every moving vehicle takes the ego's place,
along its own route.

A window is a vehicle at a frame and its next 5 s. Where they end is the goal. The goal
head learns it by cross-entropy; the policy, told the goal, learns to drive there
through the unicycle. Half of the windows begin beside the recording, so that the policy
learns to come back.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.optim.lr_scheduler import CosineAnnealingLR

from e2rl.learning.logging import RunLogger
from e2rl.learning.pretraining.supervised import Epochs, EpochSettings, stage_settings
from e2rl.planners.bits import observed
from e2rl.planners.bits_network import (
    WEIGHTS,
    BitsNetwork,
    cell_of,
    drive_controls,
    save_bits,
)
from e2rl.planners.ego import PLAN_STEPS
from e2rl.planners.path import RoutePath
from e2rl.planners.reference import LAST_ACTION
from e2rl.run.config import configured, setting
from e2rl.run.errors import InputError
from e2rl.run.parts import Parts
from e2rl.run.run import Run, origin_of
from e2rl.run.terminal import Bar
from e2rl.scenes.recording import DT
from e2rl.scenes.route import project
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_list import listed
from e2rl.scenes.source import load_scenes
from e2rl.sim.dynamics import wrap
from e2rl.sim.mission import mission_of
from e2rl.sim.world import World

# Keys of scenes: with one row an agent, one column an agent, and of vehicles' routes.
AGENT_KEYS = ("start", "start_accel", "start_yaw_rate", "valid", "size", "agent_type")
LOG_KEYS = ("logged", "logged_valid")
ROUTE_KEYS = tuple(
    f"route_{name}"
    for name in ("points", "length", "open", "limit", "light", "light_s")
)
MAP_KEYS = ("light_state", "field", "field_origin")
CHUNK = 64  # windows that are made at once
MOVES = 2.0  # m that a vehicle moves in the recording, at least
FARTHEST = 6.0  # m beside its route from which on a vehicle does not follow it
EVERY = 5  # frames of 0.1 s between the windows of a vehicle
# Standard deviations of where disturbed windows start: m beside the recording, rad, m/s.
DISTURBED = (0.5, 0.06, 1.0)
DROPOUT = 0.2  # fraction of the scene's code that is left out in training
WEIGHT_DECAY = 0.1
FEATURE_NOISE = 0.5  # standard deviations on the network's normalised input
LAST_ACTION_NOISE = 1.0


@configured("stage/bits")
@dataclass(frozen=True, kw_only=True)
class BitsSettings(EpochSettings):
    """Settings of stage=bits."""

    hidden: int = setting(low=1)


# --- windows


def as_ego(scenes: TensorDictBase, scene: Tensor, vehicle: Tensor) -> TensorDict:
    """Scenes `scene` [W] in which vehicle [W] and the ego have changed places, with no
    other vehicle's route: what a `BitsEgo` reads."""
    row = torch.arange(len(scene))
    order = torch.arange(scenes["valid"].shape[1]).repeat(len(scene), 1)
    order[row, vehicle] = 0
    order[:, 0] = vehicle
    route = scenes["route_log"][scene, vehicle]
    return TensorDict(
        {
            **{key: scenes[key][scene[:, None], order] for key in AGENT_KEYS},
            **{
                key: scenes[key].transpose(1, 2)[scene[:, None], order].transpose(1, 2)
                for key in LOG_KEYS
            },
            **{key: scenes[key][scene] for key in MAP_KEYS},
            **{
                key: scenes[key][scene, vehicle, route][:, None, None]
                for key in ROUTE_KEYS
            },
            "route_log": torch.zeros_like(route)[:, None],
        },
        batch_size=[len(scene)],
    )


def world_at(scene: TensorDictBase, step: int) -> World:
    """The Worlds of recorded scenes [W] at a step: as estimated at the start frame,
    later as recorded."""
    if step == 0:
        return World.at_start(scene)
    states = scene["logged"][:, step]
    valid = scene["logged_valid"][:, step]
    moved = (valid & scene["logged_valid"][:, step - 1])[..., None]
    change = torch.where(moved, states - scene["logged"][:, step - 1], 0.0) / DT
    return World(
        scene,
        torch.full((len(states),), step),
        states=states,
        valid=valid,
        accel=change[..., 3],
        turn_rate=wrap(change[..., 2] * DT) / DT,
    )


def windows(
    scenes: SceneSet,
    seed: int,
    disturbed: Sequence[float] = DISTURBED,
) -> TensorDict:
    """Returns windows [W] of all moving vehicles: observation [D], start [4], route [P,
    2], future [PLAN_STEPS, 4], scene_index, and the goal: distance along the route and
    lateral offset. Raises InputError where there are none."""
    recordings = scenes.scenes
    generator = torch.Generator().manual_seed(seed)
    parts = []
    vehicles = moving_vehicles(recordings).nonzero().split(CHUNK)
    for scene, vehicle in Bar(
        [part.unbind(1) for part in vehicles if len(part)], "windows"
    ):
        exchanged = as_ego(recordings, scene, vehicle=vehicle)
        for step in range(0, exchanged["logged"].shape[1] - PLAN_STEPS, EVERY):
            exact = world_at(exchanged, step)
            parts.append(_windows(exact, scene))
            displaced = _disturbed(exact, disturbed, generator=generator)
            parts.append(_windows(displaced, scene))
    joined = torch.cat(parts) if parts else TensorDict({}, [0])
    if not len(joined):
        raise InputError(
            f"{scenes.dataset}: no vehicle moves and is recorded for "
            f"{PLAN_STEPS * DT:g} s; pass others"
        )
    return joined


def moving_vehicles(scenes: TensorDictBase) -> Tensor:
    """Bool [S, V]: vehicles on known routes that move in the recording."""
    route = scenes["route_log"]
    vehicles = slice(route.shape[1])
    logged = scenes["logged"][:, :, vehicles, :2]
    distance = (logged - logged[:, :1]).norm(dim=-1)
    unknown = ~scenes["logged_valid"][:, :, vehicles]
    moves = distance.masked_fill(unknown, 0).amax(1) > MOVES
    present = scenes["valid"][:, vehicles] & ~scenes["parked"][:, vehicles]
    return present & (route >= 0) & moves


def _disturbed(
    world: World,
    size: Sequence[float],
    generator: torch.Generator,
) -> World:
    """Worlds whose egos are beside their recording, turned, and faster or slower; who
    stands stays."""
    draws = torch.randn(len(world.step), 3, generator=generator) * torch.tensor(size)
    sideways, turned, faster = draws.unbind(1)
    states = world.states.clone()
    x, y, heading, speed = states[:, 0].unbind(-1)
    part = (speed / 5).clamp(max=1)
    displaced = [
        x - sideways * part * heading.sin(),
        y + sideways * part * heading.cos(),
        wrap(heading + turned * part),
        (speed + faster * part).clamp(min=0),
    ]
    states[:, 0] = torch.stack(displaced, -1)
    return replace(world, states=states)


def _windows(world: World, scene: Tensor) -> TensorDict:
    """Windows of Worlds [B], without those whose ego's next 5 s are not recorded or
    lead away from its route."""
    step = int(world.step[0])
    stop = step + 1 + PLAN_STEPS
    route = mission_of(world.scene).points
    future = world.scene["logged"][:, step + 1 : stop, 0]
    recorded = world.scene["logged_valid"][:, step:stop, 0].all(1)
    path = RoutePath(world.states[:, 0], route)
    hint = path.s + (future[..., 3] * DT).sum(1)
    end, offset, _ = (
        value[:, 0] for value in project(future[:, -1:, :2], route, hint=hint[:, None])
    )
    columns = {
        "observation": observed(world),
        "start": world.states[:, 0],
        "route": route,
        "future": future,
        "distance": (end - path.s).clamp(min=0),
        "offset": offset,
        "scene_index": scene,
    }
    near = torch.maximum(offset.abs(), path.d.abs()) < FARTHEST
    follows = recorded & world.valid[:, 0] & near
    return TensorDict(columns, batch_size=[len(scene)])[follows]


# --- training


def losses(
    network: BitsNetwork,
    batch: TensorDictBase,
    noise: Tensor | None = None,
) -> dict[str, Tensor]:
    """Mean losses of windows [W]: goal (cross-entropy of the recorded goal's cell,
    nats), residual (of the place in it, cells), trajectory (distance from the recording
    of the plan to that goal, mean over the 5 s, m)."""
    start = batch["start"]
    distance = batch["distance"]
    offset = batch["offset"]
    path = RoutePath(start, batch["route"])
    code = network.encode(batch["observation"], noise)
    cell, residual = cell_of(start[:, 3], distance, side=offset)
    logits, residuals = network.goals(code)
    guessed = residuals.gather(1, cell[:, None, None].expand(-1, 1, 2))[:, 0]
    controls = network.controls(
        code,
        speed=start[:, 3],
        offset=path.d,
        distance=distance[:, None],
        side=offset[:, None],
    )
    states = drive_controls(controls, start, path=path).states[:, 0]
    gap = (states[..., :2] - batch["future"][..., :2]).square().sum(-1)
    return {
        "goal": F.cross_entropy(logits, cell),
        "residual": F.smooth_l1_loss(guessed, residual),
        "trajectory": ((gap + 0.01).sqrt() - 0.1).mean(),
    }


class BitsTraining(Epochs):
    """Imitation by a BitsNetwork of windows; the learning rate falls to 0 along a
    cosine."""

    def __init__(
        self,
        network: BitsNetwork,
        data: TensorDictBase,
        settings: BitsSettings,
    ) -> None:
        super().__init__(network, data, settings, network, WEIGHT_DECAY)
        steps = settings.epochs * -(-len(self.train) // settings.minibatch)
        self.schedule = CosineAnnealingLR(self.optimiser, steps)
        self.noise = torch.full_like(network.normaliser.mean, FEATURE_NOISE)
        self.noise[list(LAST_ACTION)] = LAST_ACTION_NOISE

    def loss(self, batch: TensorDictBase) -> Tensor:
        """The sum [] of the losses under noise on the input."""
        self.network.train()
        noise = self.noise * torch.randn_like(batch["observation"])
        return torch.stack([*losses(self.network, batch, noise).values()]).sum()

    def step(self, loss: Tensor) -> None:
        super().step(loss)
        self.schedule.step()

    @torch.no_grad()
    def measure(self, data: TensorDictBase) -> dict[str, float]:
        """The losses of windows and their sum `loss`."""
        self.network.eval()
        rows = [(len(part), losses(self.network, part)) for part in data.split(4096)]
        mean = {
            name: float(sum(count * row[name] for count, row in rows)) / len(data)
            for name in rows[0][1]
        }
        return mean | {"loss": sum(mean.values())}

    def weights(self) -> dict[str, Tensor]:
        return dict(self.network.state_dict())

    def set_weights(self, weights: Mapping[str, Tensor]) -> None:
        self.network.load_state_dict(weights)

    def state_dict(self) -> dict:
        return super().state_dict() | {"schedule": self.schedule.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.schedule.load_state_dict(state["schedule"])


def run_bits_stage(run: Run, logger: RunLogger) -> dict[str, float]:
    """stage=bits: a new network of ego=bits learns from the training scenes, and its
    weights are written to the run's folder. Returns the losses of the chosen epoch."""
    config = run.config
    settings = stage_settings(run.config, BitsSettings)
    scenes = load_scenes(
        config.data,
        config.num_scenes,
        split="train",
        scenes=config.scenes,
    )
    network = BitsNetwork(settings.hidden, DROPOUT).to(config.device)
    data = windows(scenes, settings.seed)
    training = BitsTraining(network, data, settings=settings)
    run.begin({"scenes": listed(scenes)})
    row = training.fit(
        "bits",
        settings.epochs,
        Parts(run.folder, "bits"),
        logger=logger,
    )
    origin = {
        "data": f"{scenes.dataset}/{scenes.split}",
        "scenes": len(scenes),
        **origin_of(run.folder),
        "windows": len(data),
        "settings": vars(settings),
        "result": row,
    }
    save_bits(network, run.folder / WEIGHTS, origin=origin)
    return row
