"""DrivingEnv: B scenes at once, the ego driven by actions, the traffic by given trajectories."""

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from e2rl.errors import InputError
from e2rl.scene.route import project
from e2rl.scene.scene import SceneSet
from e2rl.sim.around import axes, look_around
from e2rl.sim.drivable import off_road
from e2rl.sim.mission import Mission, mission_of
from e2rl.sim.observation import OBSERVATION_SIZE, EgoState, lens, observe, probe
from e2rl.sim.reward import check_weights
from e2rl.sim.setting import Place, setting_of, write_rows
from e2rl.sim.step import Rules, Running, Stepped, replay_step, step
from e2rl.sim.traffic import Traffic
from e2rl.sim.world import World

STARTING = (
    "start",
    "start_accel",
    "start_yaw_rate",
    "size",
    "agent_type",
    "field",
    "field_origin",
    "light_state",
    "route_points",
    "route_length",
    "route_open",
    "route_limit",
    "route_light",
    "route_light_s",
    "route_log",
)
DEFAULT_REWARD = {
    "progress": 0.1,
    "contact": -10.0,
    "off_road": -5.0,
    "comfort": -0.02,
    "speeding": -0.1,
    "lane_offset": -0.02,
}


@dataclass
class SimSettings:
    """Bounds of the ego's action, when an episode ends, and the reward weights (conf/sim/default.yaml).

    compile: the step by torch.compile, which needs a C++ compiler: equal but for rounding.
    """

    max_acceleration: float = 5.0
    max_braking: float = 8.0
    max_yaw_rate: float = 1.6
    end_on_contact: bool = True
    end_off_road: bool = True
    replay_ego: bool = False
    compile: bool = False
    reward: Mapping[str, float] = field(default_factory=lambda: dict(DEFAULT_REWARD))


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
        self._generator = torch.Generator()
        self.resets = 0  # counted on the host, so that policies notice new episodes without asking the device
        self._make_specs(batch_size)
        self.scene = scenes.batch(torch.zeros(batch_size, dtype=torch.long)).to(device)
        self.horizon = self.scene["logged"].shape[1] - 1
        weights = torch.tensor(check_weights(settings.reward), device=self.device)
        self._rules = Rules(
            self.horizon, settings.end_on_contact, settings.end_off_road, weights, self._low, self._high
        )
        self._traffic, self._lens = Traffic(self.scene), lens(self.device)
        self._setting = setting_of(self.scene, mission_of(self.scene))
        zeros = torch.zeros(batch_size, device=device)
        flags = torch.zeros(batch_size, dtype=torch.bool, device=device)
        self._running = Running(
            zeros.long(),
            zeros[:, None].repeat(1, 4),
            zeros[:, None].repeat(1, 2),
            Place(zeros, zeros, zeros),
            flags,
            flags,
            zeros,
        )

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
            observation=number(torch.float32, OBSERVATION_SIZE),
            scene_index=number(torch.int64),
            timestep=number(torch.int64),
            metrics=Composite(
                contact=flag(),
                contact_vru=flag(),
                off_road=flag(),
                progress=number(torch.float32),
                shape=[batch],
                device=self.device,
            ),
            shape=[batch],
            device=self.device,
        )
        self.reward_spec = number(torch.float32)
        self.full_done_spec = Composite(
            done=flag(), terminated=flag(), truncated=flag(), shape=[batch], device=self.device
        )

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
        step_from = torch.as_tensor(step_from, device=self.device).expand(self._running.clock.shape)
        self._traffic.write(step_from, states, valid, route)

    def world(self) -> World:
        """The present moment. Its `scene` is the environment's own storage: overwritten at the next reset."""
        now = self._running
        states, valid, accel = self._traffic.at(now.clock)
        first = (now.clock == 0)[:, None]
        states = torch.where(first[..., None], self.scene["start"], states)
        valid = torch.where(first, self.scene["valid"], valid)
        accel = torch.where(first, self.scene["start_accel"], accel)
        return World(
            scene=self.scene,
            step=now.clock,
            states=torch.cat([now.ego[:, None], states[:, 1:]], 1),
            valid=torch.cat([now.present[:, None], valid[:, 1:]], 1),
            accel=torch.cat([now.action[:, :1], accel[:, 1:]], 1),
            route=self._traffic.route,
            plan=self._traffic.plan(now.clock),
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
        self.scenes.copy_into(self.scene, index, rows)
        fresh = self.scene if len(index) == batch else self.scene.select(*STARTING)[index]
        mission = mission_of(fresh)
        write_rows(self._setting, index, setting_of(fresh, mission))
        self._traffic.reset(self.scene, index)
        self._restart(mask, index, fresh, mission)
        self.resets += 1
        return self._reset_output()

    def _restart(self, mask: Tensor, index: Tensor, scene: TensorDictBase, mission: Mission) -> None:
        """Start states of the environments where mask [B], index [b], whose scenes are scene [b]."""
        ego = scene["start"][:, 0]
        s, d, heading = (value[:, 0] for value in project(ego[:, None, :2], mission.points))
        on_road = off_road(ego[:, None, :2], scene["field"], scene["field_origin"])[:, 0] <= 0
        first = torch.stack([scene["start_accel"][:, 0], scene["start_yaw_rate"][:, 0]], -1)
        started = Running(torch.zeros_like(index), ego, first, Place(s, d, heading), mask[index], on_road, s)

        def put(old: Tensor, new: Tensor) -> Tensor:
            return old.index_copy(0, index, new)

        old = self._running
        place = Place(*(put(*pair) for pair in zip(old.place, started.place, strict=True)))
        self._running = Running(
            *(place if isinstance(new, Place) else put(value, new) for value, new in zip(old, started, strict=True))
        )

    def _reset_output(self) -> TensorDict:
        now, world = self._running, self.world()
        turn = axes(now.ego)
        around = look_around(now.ego, turn, self._setting, world.states[:, 1:], world.valid[:, 1:], world.accel[:, 1:])
        observation, _ = observe(
            self._lens,
            self._setting,
            EgoState(now.ego, turn, now.action, now.place),
            now.clock,
            self.horizon,
            probe(self._lens, self._setting, now.ego, turn),
            around,
        )
        none = torch.zeros_like(now.present)
        return self._output(Stepped(observation, now.start_s, none, none, none, none, none, now.place.s - now.start_s))

    @torch.no_grad()  # what an environment keeps must not grow a graph, step after step
    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        replays, traffic = self.settings.replay_ego, (self._traffic.states, self._traffic.valid)
        function = replay_step if replays else step
        function = compiled(function) if self.settings.compile else function
        given = (self.scene["logged"], self.scene["logged_valid"]) if replays else tensordict["action"]
        self._running, done = function(self._running, given, traffic, self._setting, self._rules, self._lens)
        return self._output(done).set("reward", done.reward[:, None])

    def _output(self, stepped: Stepped) -> TensorDict:
        """What an environment returns of a step but the reward."""
        shape, device = self.batch_size, self.device
        metrics = {name: getattr(stepped, name)[:, None] for name in ("contact", "contact_vru", "off_road", "progress")}
        return TensorDict(
            {
                "observation": stepped.observation,
                "scene_index": self.scene["scene_index"][:, None].clone(),
                "timestep": self._running.clock[:, None].clone(),
                "metrics": TensorDict(metrics, batch_size=shape, device=device),
                "done": (stepped.terminated | stepped.truncated)[:, None],
                "terminated": stepped.terminated[:, None],
                "truncated": stepped.truncated[:, None],
            },
            batch_size=shape,
            device=device,
        )


@cache
def compiled(function: Callable) -> Callable:
    """torch.compile of a step, one for all environments; raises InputError where nothing can compile C++."""
    names = (os.environ.get("CXX", "c++"), "c++", "g++", "clang++")
    if not any(shutil.which(name) for name in names):
        raise InputError(
            "sim.compile=true: no C++ compiler found (CXX, c++, g++, clang++); install one or leave it false"
        )
    return torch.compile(function, fullgraph=True)
