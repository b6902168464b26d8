"""DrivingEnv: a batch of B scenes; actions drive the ego, tracks drive the traffic."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from e2rl.run.errors import InputError
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.scene import SceneSet
from e2rl.sim.mission import Mission, mission_of, start_place
from e2rl.sim.observation import OBSERVATION_SIZE, EgoState, features, placed_ego
from e2rl.sim.reward import check_weights
from e2rl.sim.settings import SimSettings
from e2rl.sim.static import static_scene, write_rows
from e2rl.sim.step import CONTACTS, Outcome, StepConfig, hold_step
from e2rl.sim.world import (
    AGENT_KEYS,
    START_KEYS,
    Agents,
    Tracks,
    Trajectories,
    World,
    agents_at,
)

OF_ROUTE = ("points", "length", "open", "limit", "light", "light_s", "log")
OF_SCENE = (*START_KEYS, "size", "agent_type", "field_origin", "light_state")
FLAGS = ("terminated", "truncated")
METRICS = (*CONTACTS, "off_road", "progress")


def touches(metrics: TensorDictBase) -> Tensor:
    """Bool [..., 1]: the ego touches anybody, by an environment's metrics [...]."""
    return metrics["contact"] | metrics["contact_vru"] | metrics["contact_object"]


class DrivingEnv(EnvBase):
    """Closed-loop driving in batches of recorded or synthesized scenes.

    Keys of a step: action [B, 2] (m/s^2, rad/s); observation [B, OBSERVATION_SIZE];
    reward, done, terminated, truncated [B, 1]; scene_index, timestep [B, 1] int64;
    metrics: contact (with a vehicle), contact_vru (with a pedestrian or cyclist),
    contact_object, off_road [B, 1] bool at this step and progress [B, 1], m along the
    mission since the start. With agents=True also agents: states [B, N, 4], valid [B,
    N], accel and turn_rate [B, N], for policies that plan. Maps stay in `scene`.

    An episode terminates at contact and off the road (settings). It is truncated after
    the scenes' T steps or when the ego leaves the scene. A reset takes the scenes
    "scene_index" [B, 1] of its input; without this key it draws them uniformly. The
    traffic is that of `set_traffic`, by default the recording.

    `set_seed` seeds the draws, those of transforms among them: it decides the episodes
    from the next reset on.

    With hold > 1 a step of the environment is so many steps of 0.1 s with the same
    action: rewards are summed, and an episode that ends in between stays at that
    moment. `timestep` and T count steps of 0.1 s.
    """

    def __init__(
        self,
        scenes: SceneSet,
        settings: SimSettings,
        batch_size: int,
        device="cpu",
        agents=False,
        hold: int = 1,
        observed=True,
    ) -> None:
        """observed: false for egos that do not read the observation, which is then
        empty. Raises InputError if hold is below 1."""
        if hold < 1:
            raise InputError(
                f"DrivingEnv: hold={hold}; an action lasts at least one step"
            )
        super().__init__(
            device=device,
            batch_size=[batch_size],
        )
        self.scenes = scenes
        self.settings = settings
        self.agents = agents
        self.hold = hold
        self._look = observed
        width = OBSERVATION_SIZE if observed else 0
        self._generator = torch.Generator()
        self.generators = {self._generator}
        """All that episodes are drawn with, those of transforms among them: `set_seed`
        seeds them alike."""
        self.scene = scenes.batch(torch.zeros(batch_size, dtype=torch.long)).to(device)
        """The running scenes, in one storage for the environment's lifetime: a reset
        overwrites its rows."""
        self.horizon = self.scene["logged"].shape[1] - 1
        low = [-settings.max_braking, -settings.max_yaw_rate]
        high = [settings.max_acceleration, settings.max_yaw_rate]
        ends = [settings.end_on_contact, settings.end_off_road, settings.end_when_gone]
        numbers = (ends, check_weights(settings.reward), low, high)
        self._config = StepConfig(*(torch.tensor(x, device=device) for x in numbers))
        self._trajectories = Trajectories(self.scene)
        self._static = static_scene(self.scene, mission_of(self.scene))
        flags = torch.zeros(
            batch_size,
            dtype=torch.bool,
            device=device,
        )
        self._ego = self._at_start(self.scene, self._static.mission, on_road=flags)
        # As last observed.
        self._features = torch.zeros(batch_size, width, device=device)
        self._make_specs(batch_size, self.scene["start"].shape[1])

    def _make_specs(self, batch: int, agents: int) -> None:
        bounds = (self._config.low, self._config.high)
        self.action_spec = Bounded(
            *(bound.repeat(batch, 1) for bound in bounds), device=self.device
        )

        def flag(size: int = 1) -> Binary:
            return Binary(
                size,
                shape=(batch, size),
                dtype=torch.bool,
                device=self.device,
            )

        def number(*size: int, dtype: torch.dtype = torch.float32) -> Unbounded:
            return Unbounded(
                (batch, *(size or (1,))),
                dtype=dtype,
                device=self.device,
            )

        def group(**specs) -> Composite:
            return Composite(**specs, shape=[batch], device=self.device)

        specs = {
            "observation": number(self._features.shape[1]),
            "scene_index": number(dtype=torch.int64),
            "timestep": number(dtype=torch.int64),
            "metrics": group(**dict.fromkeys(METRICS[:-1], flag()), progress=number()),
        }
        if self.agents:
            specs["agents"] = group(
                states=number(agents, 4),
                valid=flag(agents),
                accel=number(agents),
                turn_rate=number(agents),
            )
        self.observation_spec = group(**specs)
        self.reward_spec = number()
        self.full_done_spec = group(
            done=flag(),
            terminated=flag(),
            truncated=flag(),
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            for generator in self.generators:
                generator.manual_seed(seed)

    def set_traffic(
        self,
        rows: Tensor,
        states: Tensor,
        valid: Tensor,
    ) -> None:
        """Set the traffic of environments rows [b] int64 from their next reset on,
        instead of the recording.

        states [b, T+1, N, 4], valid [b, T+1, N]; step 0 must be the scene's start. The
        ego's row is ignored; pedestrians, cyclists and others keep replaying the log.
        Raises InputError on a wrong shape or NaN.
        """
        self._trajectories.schedule(rows, states, valid)

    def write_traffic(
        self,
        rows: Tensor,
        states: Tensor,
        valid: Tensor,
    ) -> None:
        """Overwrite the vehicles' traffic of environments rows [b] at the coming steps;
        steps beyond T are dropped.

        states [b, V, H, 4], valid [b, V, H].
        """
        step = self._ego.step[rows]
        self._trajectories.write(
            rows,
            step=step,
            states=states,
            valid=valid,
        )

    def world(self) -> World:
        """The current World. Its `scene` is the environment's own storage, which the
        next reset overwrites."""
        ego = self._ego
        of_ego = (ego.state, ego.present, ego.action[:, 0], ego.action[:, 1])
        driven = agents_at(self._trajectories.tracks, ego.step)
        begins = ego.step == 0
        agents = {}
        for key, start_key, mine, later in zip(
            AGENT_KEYS,
            START_KEYS,
            of_ego,
            driven,
            strict=True,
        ):
            first = self.scene[start_key]
            begins = begins.view(-1, *[1] * (first.ndim - 1))
            others = torch.where(begins, first, later)[:, 1:]
            agents[key] = torch.cat([mine[:, None], others], 1)
        return World(self.scene, ego.step, **agents, mission_s=ego.pose.s)

    def _reset(self, tensordict: TensorDictBase | None = None, **_) -> TensorDict:
        batch = self.batch_size[0]
        request = TensorDict() if tensordict is None else tensordict
        every = torch.ones(
            batch,
            dtype=torch.bool,
            device=self.device,
        )
        index = request.get("_reset", every).view(batch).nonzero().squeeze(-1)
        chosen = request.get("scene_index", None)
        if chosen is None:
            rows = torch.randint(
                len(self.scenes),
                (len(index),),
                generator=self._generator,
            )
        else:
            rows = chosen.view(batch)[index].cpu()
        self.scenes.copy_into(self.scene, index, rows)
        fresh = self.scene if len(index) == batch else self._beginning(index)
        static = static_scene(fresh, mission_of(fresh))
        write_rows(self._static, index, static)
        self._trajectories.reset(self.scene, index)
        # Of all environments: the fields stay where they are.
        start = self.scene["start"][:, :1, :2]
        field = self.scene["field"]
        beyond = off_road(start, field, origin=self.scene["field_origin"])[index, 0]
        ego = self._at_start(fresh, static.mission, on_road=beyond <= 0)
        self._ego = self._ego.merged(
            ego, lambda old, new: old.index_copy(0, index, new)
        )
        if self._look:
            if len(index) < batch:
                static = static._replace(field=field.index_select(0, index))
            others = Agents(*(fresh[name][:, 1:] for name in START_KEYS))
            observation = features(static, ego, others, ego.step / self.horizon)
            self._features = self._features.index_copy(0, index, observation)
        nothing = torch.zeros_like(self._ego.present)
        outcome = dict.fromkeys((*FLAGS, *METRICS), nothing)
        outcome["progress"] = self._ego.pose.s - self._ego.start_s
        return self._output(outcome | {"observation": self._features})

    def _beginning(self, index: Tensor) -> TensorDict:
        """What a reset of environments index [b] needs of their scenes; of routes and
        recording, that of the ego."""
        scene = {name: self.scene[name].index_select(0, index) for name in OF_SCENE}
        for name in OF_ROUTE:
            scene[f"route_{name}"] = self.scene[f"route_{name}"][:, :1][index]
        for name in ("logged", "logged_valid"):
            scene[name] = self.scene[name][:, :, :1][index]
        # Storage that write_rows leaves alone.
        scene["field"] = self.scene["field"][: len(index)]
        return TensorDict(
            scene,
            batch_size=[len(index)],
            device=self.device,
        )

    @staticmethod
    def _at_start(scene: TensorDictBase, mission: Mission, on_road: Tensor) -> EgoState:
        """The egos at the start of scenes [b], on_road [b] or not."""
        state = scene["start"][:, 0]
        action = [scene["start_accel"][:, 0], scene["start_yaw_rate"][:, 0]]
        ego = placed_ego(
            mission,
            state,
            step=torch.zeros_like(on_road, dtype=torch.int64),
            action=torch.stack(action, -1),
            present=torch.ones_like(on_road),
            place=start_place(mission, state),
            others=scene["valid"][:, 1:],
        )
        return ego._replace(been_on_road=on_road)

    @torch.no_grad()  # the stored state must not accumulate an autograd graph
    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        command = tensordict["action"]
        if self.settings.replay_ego:
            command = Tracks(self.scene["logged"], self.scene["logged_valid"])
        self._ego, outcome = hold_step(
            self._ego,
            command,
            hold=self.hold,
            tracks=self._trajectories.tracks,
            static=self._static,
            config=self._config,
            look=self._look,
        )
        self._features = outcome["observation"]
        return self._output(outcome).set("reward", outcome["reward"][:, None])

    def _output(self, outcome: Outcome) -> TensorDict:
        """The step's output TensorDict without the reward."""
        flags = {name: outcome[name][:, None] for name in FLAGS}
        metrics = {name: outcome[name][:, None] for name in METRICS}
        result = {
            "observation": outcome["observation"],
            "scene_index": self.scene["scene_index"][:, None].clone(),
            "timestep": self._ego.step[:, None].clone(),
            "metrics": self._group(metrics),
            "done": flags["terminated"] | flags["truncated"],
            **flags,
        }
        if self.agents:
            world = self.world()
            agents = {key: getattr(world, key) for key in AGENT_KEYS}
            result["agents"] = self._group(agents)
        return self._group(result)

    def _group(self, values: dict[str, Any]) -> TensorDict:
        return TensorDict(values, self.batch_size, device=self.device)
