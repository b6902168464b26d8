"""DrivingEnv: B scenes at once, the ego driven by actions, the traffic by given trajectories."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from e2rl.scene.recording import DT, VEHICLE
from e2rl.scene.route import project
from e2rl.scene.scene import SceneSet
from e2rl.sim import dynamics
from e2rl.sim.drivable import off_road
from e2rl.sim.geometry import separation
from e2rl.sim.mission import Mission, limit_at, mission_of
from e2rl.sim.observation import OBSERVATION_SIZE, observe
from e2rl.sim.reward import check_weights, reward_terms, weighted_sum
from e2rl.sim.traffic import Traffic
from e2rl.sim.world import World

DEFAULT_REWARD = {
    "progress": 0.1, "contact": -10.0, "off_road": -5.0, "comfort": -0.02, "speeding": -0.1, "lane_offset": -0.02,
}


@dataclass
class SimSettings:
    """Bounds of the ego's action, when an episode ends, and the reward weights (conf/sim/default.yaml)."""

    max_acceleration: float = 5.0
    max_braking: float = 8.0
    max_yaw_rate: float = 1.6
    end_on_contact: bool = True
    end_off_road: bool = True
    replay_ego: bool = False
    reward: Mapping[str, float] = field(default_factory=lambda: dict(DEFAULT_REWARD))


@dataclass
class Outcome:
    """What one step did, each [B]: contact with a vehicle and with another agent, off the road (all bool), way [m]."""

    contact: Tensor
    contact_vru: Tensor
    off_road: Tensor
    way: Tensor


class DrivingEnv(EnvBase):
    """Closed-loop driving in batches of recorded or synthesized scenes.

    Keys of the step: action [B, 2] (m/s^2, rad/s); observation [B, OBSERVATION_SIZE]; reward, done, terminated,
    truncated [B, 1]; scene_index, timestep [B, 1] int64; metrics: contact, contact_vru, off_road [B, 1] bool at this
    step and progress [B, 1], metres along the mission since the start. Maps stay here: read them by `world()`.

    An episode terminates at contact and off the road (settings) and is truncated after the scenes' T steps or where
    the map ends. A reset takes the scenes named by "scene_index" [B, 1] in its input, else draws them uniformly from
    the environment's own generator (`set_seed`). Their traffic is what `set_traffic` gave, else the recording.
    """

    def __init__(self, scenes: SceneSet, settings: SimSettings, batch_size: int, device="cpu") -> None:
        super().__init__(device=device, batch_size=[batch_size])
        self.scenes, self.settings = scenes, settings
        self._weights = check_weights(settings.reward)
        self._generator = torch.Generator()
        self.resets = 0  # counted on the host, so that policies notice new episodes without asking the device
        self._make_specs(batch_size)
        self.scene = scenes.batch(torch.zeros(batch_size, dtype=torch.long)).to(device)
        self.horizon = self.scene["logged"].shape[1] - 1
        self._traffic = Traffic(self.scene)
        zeros = torch.zeros(batch_size, device=device)
        self._clock = zeros.long()
        self._ego, self._action = zeros[:, None].repeat(1, 4), zeros[:, None].repeat(1, 2)
        self._present, self._been_on_road = zeros.bool(), zeros.bool()
        self._place: tuple[Tensor, Tensor, Tensor] = (zeros, zeros, zeros)
        self._start_s = zeros
        self.mission: Mission = mission_of(self.scene)

    def _make_specs(self, batch: int) -> None:
        low = torch.tensor([-self.settings.max_braking, -self.settings.max_yaw_rate], device=self.device)
        high = torch.tensor([self.settings.max_acceleration, self.settings.max_yaw_rate], device=self.device)
        self.action_spec = Bounded(low.repeat(batch, 1), high.repeat(batch, 1), device=self.device)
        self._low, self._high = low, high

        def flag() -> Binary:
            return Binary(1, shape=(batch, 1), dtype=torch.bool, device=self.device)

        def number(dtype: torch.dtype, size: int = 1) -> Unbounded:
            return Unbounded((batch, size), dtype=dtype, device=self.device)

        self.observation_spec = Composite(
            observation=number(torch.float32, OBSERVATION_SIZE), scene_index=number(torch.int64),
            timestep=number(torch.int64),
            metrics=Composite(contact=flag(), contact_vru=flag(), off_road=flag(), progress=number(torch.float32),
                              shape=[batch], device=self.device),
            shape=[batch], device=self.device,
        )
        self.reward_spec = number(torch.float32)
        self.full_done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=[batch],
                                        device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._generator.manual_seed(seed)

    def set_traffic(self, rows: Tensor, states: Tensor, valid: Tensor, route: Tensor | None = None) -> None:
        """Traffic of environments rows [b] int64 from their coming reset on, instead of the recording.

        states [b, T+1, N, 4], valid [b, T+1, N]; step 0 is taken to be the scene's start. The ego's row is ignored,
        pedestrians, cyclists and others keep replaying the log. route [b, V]: candidates followed, default route_log.
        """
        self._traffic.schedule(rows, states, valid, route)

    def write_traffic(
        self, step_from: int | Tensor, states: Tensor, valid: Tensor, route: Tensor | None = None
    ) -> None:
        """Overwrite the vehicles' traffic at steps step_from + 1 .. step_from + h of all environments.

        step_from: int or [B]; states [B, h, N, 4], valid [B, h, N]; steps beyond T are dropped from the traffic but
        stay in `World.plan`. route [B, V]: candidates now followed, default unchanged.
        """
        step_from = torch.as_tensor(step_from, device=self.device).expand(self._clock.shape)
        self._traffic.write(step_from, states, valid, route)

    def world(self) -> World:
        """The present moment. Its `scene` is the environment's own storage: overwritten at the next reset."""
        states, valid, accel = self._traffic.at(self._clock)
        first = (self._clock == 0)[:, None]
        states = torch.where(first[..., None], self.scene["start"], states)
        valid = torch.where(first, self.scene["valid"], valid)
        accel = torch.where(first, self.scene["start_accel"], accel)
        return World(
            scene=self.scene, step=self._clock,
            states=torch.cat([self._ego[:, None], states[:, 1:]], 1),
            valid=torch.cat([self._present[:, None], valid[:, 1:]], 1),
            accel=torch.cat([self._action[:, :1], accel[:, 1:]], 1),
            route=self._traffic.route, plan=self._traffic.plan(self._clock),
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **_) -> TensorDict:
        batch = self.batch_size[0]
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(batch, dtype=torch.bool, device=self.device) if mask is None else mask.view(batch)
        index = mask.nonzero().squeeze(-1)
        chosen = None if tensordict is None else tensordict.get("scene_index", None)
        if chosen is None:
            rows = torch.randint(len(self.scenes), (len(index),), generator=self._generator)
        else:
            rows = chosen.view(batch)[index].cpu()
        self.scene[index] = self.scenes.batch(rows).to(self.device)
        self.mission = mission_of(self.scene)
        self._traffic.reset(self.scene, index)
        self._restart_ego(mask)
        self.resets += 1
        none = torch.zeros(batch, dtype=torch.bool, device=self.device)
        return TensorDict(
            self._observed(Outcome(none, none, none, self._place[0] - self._start_s)) | self._done(none, none),
            batch_size=self.batch_size, device=self.device,
        )

    def _restart_ego(self, mask: Tensor) -> None:
        """Start state, mission place and flags of the environments where mask [B]."""
        scene, column = self.scene, mask[:, None]
        first = torch.stack([scene["start_accel"][:, 0], scene["start_yaw_rate"][:, 0]], -1)
        self._ego = torch.where(column, scene["start"][:, 0], self._ego)
        self._action = torch.where(column, first, self._action)
        self._clock = self._clock.masked_fill(mask, 0)
        self._present = self._present | mask
        on_road = self._beyond_border() <= 0
        self._been_on_road = torch.where(mask, on_road, self._been_on_road)
        self._place = tuple(map(lambda new, old: torch.where(mask, new, old), self._project(None), self._place))
        self._start_s = torch.where(mask, self._place[0], self._start_s)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        before, last_action = self._ego, self._action
        self._clock = (self._clock + 1).clamp(max=self.horizon)
        if self.settings.replay_ego:
            row = torch.arange(len(self._clock), device=self.device)
            known = self.scene["logged_valid"][row, self._clock, 0]
            self._ego = torch.where(known[:, None], self.scene["logged"][row, self._clock, 0], before)
            self._present = self._present & known
        else:
            action = torch.maximum(torch.minimum(tensordict["action"], self._high), self._low)
            self._ego = dynamics.step(before, action)
        self._action = dynamics.inverse(torch.stack([before, self._ego], 1))[:, 0]
        old_s = self._place[0]
        self._place = self._project(old_s + before[:, 3] * DT)
        outcome = self._outcome(old_s)
        left = ~self._present | (self._place[0] >= self.mission.end)
        s, offset, _ = self._place
        terms = reward_terms(
            outcome.way, outcome.contact | outcome.contact_vru, outcome.off_road, self._action, last_action,
            self._ego[:, 3], limit_at(self.mission, s), offset, DT,
        )
        self._present = ~left
        touched = (outcome.contact | outcome.contact_vru) & self.settings.end_on_contact
        terminated = touched | (outcome.off_road & self.settings.end_off_road)
        truncated = (self._clock >= self.horizon) | left
        reward = {"reward": weighted_sum(terms, self._weights)[:, None]}
        return TensorDict(
            self._observed(outcome) | self._done(terminated, truncated) | reward, batch_size=self.batch_size,
            device=self.device,
        )

    def _outcome(self, old_s: Tensor) -> Outcome:
        """Contact is looked for against every agent present; off the road counts from the first time on it."""
        states, valid, _ = self._traffic.at(self._clock)
        size = self.scene["size"]
        gap = separation(self._ego[:, None], size[:, :1], states[:, 1:], size[:, 1:])
        hit = (gap < 0) & valid[:, 1:] & self._present[:, None]
        vehicle = self.scene["agent_type"][:, 1:] == VEHICLE
        beyond = self._beyond_border() > 0
        off = beyond & self._been_on_road & self._present
        self._been_on_road = self._been_on_road | ~beyond
        return Outcome((hit & vehicle).any(1), (hit & ~vehicle).any(1), off, self._place[0] - old_s)

    def _beyond_border(self) -> Tensor:
        return off_road(self._ego[:, None, :2], self.scene["field"], self.scene["field_origin"])[:, 0]

    def _project(self, hint: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Arc length, offset and heading, each [B], of the mission route at the ego."""
        hint = None if hint is None else hint[:, None]
        return tuple(value[:, 0] for value in project(self._ego[:, None, :2], self.mission.points, hint))

    def _observed(self, outcome: Outcome) -> dict:
        flags = {name: getattr(outcome, name)[:, None] for name in ("contact", "contact_vru", "off_road")}
        progress = (self._place[0] - self._start_s)[:, None]
        return {
            "observation": observe(self.world(), self.mission, self._place, self._action),
            "scene_index": self.scene["scene_index"][:, None].clone(),
            "timestep": self._clock[:, None].clone(),
            "metrics": TensorDict(flags | {"progress": progress}, batch_size=self.batch_size, device=self.device),
        }

    def _done(self, terminated: Tensor, truncated: Tensor) -> dict:
        return {"done": (terminated | truncated)[:, None], "terminated": terminated[:, None],
                "truncated": truncated[:, None]}
