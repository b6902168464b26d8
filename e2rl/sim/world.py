"""The input of planners and traffic methods, the current state of running scenes, and
the tracks of others."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.run.errors import InputError
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap
from e2rl.sim.mission import mission_of, start_place

# Of World, of the environment's `agents`, and of Agents.
AGENT_KEYS = ("states", "valid", "accel", "turn_rate")
# Of a scene: the same at its start.
START_KEYS = ("start", "valid", "start_accel", "start_yaw_rate")


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
        states, valid, accel, turn_rate = (scene[key] for key in START_KEYS)
        return cls(
            scene,
            step=torch.zeros(
                len(states),
                dtype=torch.int64,
                device=states.device,
            ),
            states=states,
            valid=valid,
            accel=accel,
            turn_rate=turn_rate,
            route=scene["route_log"],
            mission_s=start_place(mission_of(scene), states[:, 0]),
        )

    @classmethod
    def of(cls, tensordict: TensorDictBase, scene: TensorDictBase) -> "World":
        """The World that a DrivingEnv with `agents=True` reports in a TensorDict [B];
        scene: `DrivingEnv.scene`."""
        progress = tensordict.get(("metrics", "progress"), None)
        mission_s = None
        if progress is not None:  # collected frames may have none
            begin = start_place(mission_of(scene), scene["start"][:, 0])
            mission_s = begin + progress[:, 0]
        return cls(
            scene,
            step=tensordict["timestep"][:, 0],
            **{key: tensordict["agents"][key] for key in AGENT_KEYS},
            plan=tensordict.get(("traffic", "plan"), None),
            mission_s=mission_s,
        )

    def shown(self, scene: TensorDictBase | None = None) -> "World":
        """A copy for code from outside the package: changes to it have no effect, and
        it holds nothing of the future. Lights stay as they are now, absent agents have
        no size and type, and no plan is known.

        scene: `without_future` of this World's scene, where it is at hand.
        """
        scene = (without_future(self.scene) if scene is None else scene).copy()
        lights = self.scene["light_state"]
        steps = torch.arange(lights.shape[1], device=lights.device)
        last = steps.minimum(self.step[:, None])[..., None]
        scene["light_state"] = lights.gather(1, last.expand_as(lights))
        scene["size"] = torch.where(self.valid[..., None], self.scene["size"], 1.0)
        scene["agent_type"] = self.scene["agent_type"] * self.valid
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


class Tracks(NamedTuple):
    """What all agents of B scenes do, the ego first: states [B, T+1, N, 4], valid [B,
    T+1, N] bool."""

    states: Tensor
    valid: Tensor


class Trajectories:
    """The tracks of B running scenes.

    Vehicles (the first V rows) may be overwritten; pedestrians, cyclists and others
    always replay the recording.
    """

    def __init__(self, scene: TensorDictBase) -> None:
        self.tracks = Tracks(scene["logged"].clone(), scene["logged_valid"].clone())
        self.vehicles = scene["route_log"].shape[1]
        self._scheduled: list[tuple[Tensor, Tracks]] = []

    def schedule(
        self,
        rows: Tensor,
        states: Tensor,
        valid: Tensor,
    ) -> None:
        """See `DrivingEnv.set_traffic`."""
        expected = (len(rows), *self.tracks.states.shape[1:])
        if tuple(states.shape) != expected or tuple(valid.shape) != expected[:-1]:
            raise InputError(
                f"set_traffic: states {tuple(states.shape)} and valid "
                f"{tuple(valid.shape)} for {len(rows)} rows; expected {expected} and "
                f"{expected[:-1]}"
            )
        if not torch.isfinite(states[valid]).all():
            raise InputError(
                "set_traffic: NaN or infinite states marked valid; mark them invalid"
            )
        states = states.to(self.tracks.states)
        traffic = Tracks(states, valid.to(states.device))
        self._scheduled.append((rows.to(states.device), traffic))

    def reset(self, scene: TensorDictBase, index: Tensor) -> None:
        """Restart scenes index [b] with their scheduled trajectories, by default with
        the recording."""
        recording = Tracks(scene["logged"], scene["logged_valid"])
        for track, recorded in zip(self.tracks, recording, strict=True):
            if len(index) == len(track):
                track.copy_(recorded)
            else:
                track.index_copy_(0, index, recorded.index_select(0, index))
        waiting = self._scheduled
        self._scheduled = []
        for rows, traffic in waiting:
            due = torch.isin(rows, index)
            for track, value in zip(self.tracks, traffic, strict=True):
                track[rows[due], :, : self.vehicles] = value[due][:, :, : self.vehicles]
            if not bool(due.all()):
                rest = Tracks(*(value[~due] for value in traffic))
                self._scheduled.append((rows[~due], rest))

    def write(
        self,
        rows: Tensor,
        *,
        step: Tensor,
        states: Tensor,
        valid: Tensor,
    ) -> None:
        """See `DrivingEnv.write_traffic`.

        Args:
            rows, states, valid: as there.
            step: [b], after which the states follow.
        """
        at = step[:, None] + torch.arange(1, states.shape[2] + 1, device=step.device)
        inside = at < self.tracks.states.shape[1]
        row = rows[:, None].expand_as(at)[inside]
        at = at[inside]
        for track, value in zip(self.tracks, (states, valid), strict=True):
            coming = value.transpose(1, 2)[inside]
            track[row, at, : self.vehicles] = coming.to(track.dtype)


def agents_at(tracks: Tracks, step: Tensor) -> Agents:
    """The agents of tracks [B, T+1, N] at step [B].

    Acceleration and turn rate are differences of speed and heading over the last step,
    0 without a last step.
    """
    batch, steps, _ = tracks.valid.shape
    first = torch.arange(0, batch * steps, steps, device=step.device)
    # Whole rows are copied faster than picked numbers.
    at = torch.cat([first + step, first + (step - 1).clamp(min=0)])
    states, before = tracks.states.flatten(0, 1).index_select(0, at).chunk(2)
    present, was = tracks.valid.flatten(0, 1).index_select(0, at).chunk(2)
    change = states[..., 2:] - before[..., 2:]
    both = present & was
    accel = change[..., 1] / DT * both
    return Agents(states, present, accel, turn_rate=wrap(change[..., 0]) / DT * both)
