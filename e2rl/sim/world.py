"""The input of planners and traffic methods, the current state of running scenes, and
the trajectories of others."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.run.errors import InputError
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap
from e2rl.sim.mission import mission_of, start_place

AGENT_KEYS = (
    "states",
    "valid",
    "accel",
    "turn_rate",
)  # of World, of the environment's `agents`, and of Agents
START_KEYS = (
    "start",
    "valid",
    "start_accel",
    "start_yaw_rate",
)  # of a scene: the same at its start


@dataclass
class World:
    """The current state of B scenes; agent 0 is the ego, agents [:V] are the vehicles.

    scene: Scene TensorDict [B]; step [B] int64: simulated steps since the start frame;
    states [B, N, 4]: x, y [m], heading [rad], speed [m/s]; valid [B, N]: present now;
    accel [B, N] m/s^2 and turn_rate [B, N] rad/s: over the last step, the ego's as
    executed; route [B, V] int64: the route candidates that the vehicles follow; plan
    [B, V, H, 4]: their planned states at the coming steps; mission_s [B] m: arc length
    of the ego on its mission, as followed since the start (of these, None: unknown).
    """

    scene: TensorDictBase
    step: Tensor
    states: Tensor
    valid: Tensor
    accel: Tensor
    turn_rate: Tensor
    route: Tensor | None = None
    plan: Tensor | None = None
    mission_s: Tensor | None = None

    @classmethod
    def at_start(cls, scene: TensorDictBase) -> "World":
        """Scenes [B] at their start frames."""
        step = torch.zeros(
            scene.batch_size[0], dtype=torch.int64, device=scene["start"].device
        )
        states, valid, accel, turn_rate = (scene[key] for key in START_KEYS)
        mission_s = start_place(mission_of(scene), states[:, 0])
        return cls(
            scene,
            step,
            states,
            valid,
            accel,
            turn_rate,
            scene["route_log"],
            mission_s=mission_s,
        )

    @classmethod
    def of(cls, tensordict: TensorDictBase, scene: TensorDictBase) -> "World":
        """The World that a DrivingEnv with `agents=True` reports in a TensorDict [B];
        scene: `DrivingEnv.scene`."""
        states, valid, accel, turn_rate = (
            tensordict["agents"][key] for key in AGENT_KEYS
        )
        plan = tensordict.get(("traffic", "plan"), None)
        progress, mission_s = (
            tensordict.get(("metrics", "progress"), None),
            None,
        )  # collected frames may have none
        if progress is not None:
            mission_s = (
                start_place(mission_of(scene), scene["start"][:, 0]) + progress[:, 0]
            )
        step = tensordict["timestep"][:, 0]
        return cls(
            scene, step, states, valid, accel, turn_rate, plan=plan, mission_s=mission_s
        )

    def shown(self, scene: TensorDictBase | None = None) -> "World":
        """A copy for code from outside the package: changes to it have no effect, and
        it holds nothing of the future. Lights stay as they are now, absent agents have
        no size and type, and no plan is known.

        scene: `without_future` of this World's scene, where it is made already.
        """
        scene = (without_future(self.scene) if scene is None else scene).copy()
        lights = self.scene["light_state"]
        there = self.valid
        last = torch.arange(lights.shape[1], device=there.device).minimum(
            self.step[:, None]
        )
        scene["light_state"] = lights.gather(1, last[..., None].expand_as(lights))
        scene["size"] = torch.where(there[..., None], self.scene["size"], 1.0)
        scene["agent_type"] = self.scene["agent_type"] * there
        agents = {key: getattr(self, key).clone() for key in AGENT_KEYS}
        mission_s = None if self.mission_s is None else self.mission_s.clone()
        return World(scene, self.step.clone(), **agents, mission_s=mission_s)

    def ego_action(self) -> Tensor:
        """The egos' last executed acceleration and yaw rate [B, 2]."""
        return torch.stack([self.accel[:, 0], self.turn_rate[:, 0]], -1)

    def others(self) -> "Agents":
        """All agents but the ego."""
        return Agents(*(getattr(self, key)[:, 1:] for key in AGENT_KEYS))


def without_future(scene: TensorDictBase) -> TensorDictBase:
    """A copy of scenes [B] that tells nothing of what was recorded after their start
    frames, but the egos' missions and the lights."""
    scene = scene.clone()
    for key in ("logged", "logged_valid"):
        scene[key][:, 1:] = 0
    scene["route_log"][:, 1:] = -1
    return scene


class Agents(NamedTuple):
    """All agents of B scenes at a moment: states [B, N, 4], present [B, N] bool, accel
    [B, N] m/s^2, turn_rate [B, N] rad/s."""

    states: Tensor
    present: Tensor
    accel: Tensor
    turn_rate: Tensor


AGENTS = ("B M 4", "B M:bool", "B M", "B M")
"""Shapes of Agents' tensors in fused functions."""


class Trajectories:
    """Trajectories states [B, T+1, N, 4], valid [B, T+1, N] of B running scenes.

    Vehicles (the first V rows) may be overwritten; pedestrians, cyclists and others
    always replay the recording.
    """

    def __init__(self, scene: TensorDictBase) -> None:
        self.states = scene["logged"].clone()
        self.valid = scene["logged_valid"].clone()
        self.vehicles = scene["route_log"].shape[1]
        self._scheduled: list[tuple[Tensor, Tensor, Tensor]] = []

    def schedule(self, rows: Tensor, states: Tensor, valid: Tensor) -> None:
        """See `DrivingEnv.set_traffic`."""
        expected = (len(rows), *self.states.shape[1:])
        if tuple(states.shape) != expected or tuple(valid.shape) != expected[:-1]:
            given = f"states {tuple(states.shape)} and valid {tuple(valid.shape)}"
            raise InputError(
                f"set_traffic: {given} for {len(rows)} rows; expected {expected} and {expected[:-1]}"
            )
        if not torch.isfinite(states[valid]).all():
            raise InputError(
                "set_traffic: NaN or infinite states marked valid; mark them invalid"
            )
        device = self.states.device
        self._scheduled.append((rows.to(device), states.to(device), valid.to(device)))

    def reset(self, scene: TensorDictBase, index: Tensor) -> None:
        """Restart scenes index [b] with their scheduled trajectories, by default with
        the recording."""
        if len(index) == len(self.states):
            self.states.copy_(scene["logged"]), self.valid.copy_(scene["logged_valid"])
        else:
            self.states.index_copy_(0, index, scene["logged"].index_select(0, index))
            self.valid.index_copy_(
                0, index, scene["logged_valid"].index_select(0, index)
            )
        waiting = self._scheduled
        self._scheduled = []
        for rows, states, valid in waiting:
            now = torch.isin(rows, index)
            self.states[rows[now], :, : self.vehicles] = states[now][
                :, :, : self.vehicles
            ].to(self.states.dtype)
            self.valid[rows[now], :, : self.vehicles] = valid[now][
                :, :, : self.vehicles
            ]
            if not bool(now.all()):
                self._scheduled.append((rows[~now], states[~now], valid[~now]))

    def write(self, rows: Tensor, step: Tensor, states: Tensor, valid: Tensor) -> None:
        """See `DrivingEnv.write_traffic`; from step [b] + 1 on."""
        at = step[:, None] + torch.arange(1, states.shape[2] + 1, device=step.device)
        inside = at < self.states.shape[1]
        row = rows[:, None].expand_as(at)[inside]
        at = at[inside]
        self.states[row, at, : self.vehicles] = states.transpose(1, 2)[inside].to(
            self.states.dtype
        )
        self.valid[row, at, : self.vehicles] = valid.transpose(1, 2)[inside]


def trajectories_at(states: Tensor, valid: Tensor, step: Tensor) -> Agents:
    """The agents of trajectories [B, T+1, N, 4], [B, T+1, N] at step [B].

    Acceleration and turn rate are differences of speed and heading over the last step,
    0 without a last step.
    """
    first = torch.arange(
        0, valid.shape[0] * valid.shape[1], valid.shape[1], device=step.device
    )
    at = torch.cat(
        [first + step, first + (step - 1).clamp(min=0)]
    )  # whole rows are copied faster than picked numbers
    now, before = states.flatten(0, 1).index_select(0, at).chunk(2)
    there, was = valid.flatten(0, 1).index_select(0, at).chunk(2)
    change = now[..., 2:] - before[..., 2:]
    known = there & was
    return Agents(
        now,
        there,
        accel=change[..., 1] / DT * known,
        turn_rate=wrap(change[..., 0]) / DT * known,
    )
