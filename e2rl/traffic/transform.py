"""AdversarialSynthesizer: the TorchRL transform that sets the scene and the traffic of
every episode."""

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, Transform

from e2rl.planners.ego import Ego
from e2rl.planners.ego_errors import renumbered
from e2rl.prior.lane_relative import HORIZON
from e2rl.run.errors import InputError
from e2rl.sim.env import DrivingEnv
from e2rl.traffic.grouping import put_rows, take_rows
from e2rl.traffic.lookahead import Lookahead
from e2rl.traffic.pool import LIVE, TrafficPool
from e2rl.traffic.traffic import (
    REPLAN_STEPS,
    State,
    Traffic,
    TrafficPlan,
    keep_velocity,
)

Draw = Callable[[int], Tensor]  # count -> pool rows [count] of new episodes


class AdversarialSynthesizer(Transform):
    """Draws a pool row for every new episode, injects its scene, and drives its
    traffic.

    Rows with recorded or stored traffic replay it. LIVE rows are replanned by the
    traffic method every REPLAN_STEPS steps. It is given ("ego", "plan") [B, H, 4],
    which the policy has just written (without this key, constant velocity), and may not
    look at it (`Traffic.knowledge`).

    Writes ("traffic", ...): row [B, 1] int64 and, with a traffic method, plan [B, V, H,
    4]: states planned for the coming steps, only for the policy, not stacked over time.
    Everything else about a plan is handed to `on_plan`.
    """

    def __init__(
        self,
        pool: TrafficPool,
        draw: Draw,
        traffic: Traffic | None = None,
        ego: Ego | None = None,
    ) -> None:
        """Args:
        pool: rows that episodes are drawn from.
        draw: count -> pool rows [count]; `env.set_seed` seeds its `generator`, if it
            has one.
        traffic: drives LIVE rows.
        ego: the ego that a method with `queries_ego` queries.
        """
        super().__init__()
        self.pool = pool
        self.draw = draw
        self.traffic = traffic
        self.ego = ego
        # Called with every new plan.
        self.on_plan: Callable[[TrafficPlan], None] | None = None
        nothing = torch.zeros(0, dtype=torch.int64)  # before the first reset
        self._drawn = nothing  # [B] pool row of each episode
        self._state: State = None
        self._plan = torch.zeros(0)  # [B, V, HORIZON, 4] the plans being driven
        self._planned_at = nothing  # [B] step of the last replan, per environment

    def set_container(self, container: Transform | EnvBase) -> None:
        """Let the environment's `set_seed`, which skips transforms, reach the draws."""
        super().set_container(container)
        generator = getattr(self.draw, "generator", None)
        if self.parent is not None and generator is not None:
            self._env.generators.add(generator)  # a Compose may have no environment yet

    @property
    def _env(self) -> DrivingEnv:
        return self.parent.base_env

    @property
    def _method(self) -> Traffic:
        assert self.traffic is not None
        return self.traffic

    def _reset_env_preprocess(
        self, tensordict: TensorDictBase | None
    ) -> TensorDictBase:
        env = self._env
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=env.batch_size, device=env.device)
        mask = tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones(env.batch_size, dtype=torch.bool)
        rows = mask.view(env.batch_size).cpu().nonzero()[:, 0]
        if not len(self._drawn):
            self._drawn = torch.zeros(env.batch_size, dtype=torch.int64)
        self._drawn[rows] = self.draw(len(rows)).cpu()
        self._inject(rows)
        scene_index = self.pool.scene_index[self._drawn][:, None]
        tensordict["scene_index"] = scene_index.to(env.device)
        return tensordict

    def _inject(self, rows: Tensor) -> None:
        """Schedule stored traffic for the next reset of environments rows [b]."""
        source = self.pool.source[self._drawn[rows]]
        stored = source >= 0
        if bool(stored.any()):
            self._env.set_traffic(
                rows[stored].to(self._env.device), *self.pool.tracks(source[stored])
            )

    def _reset(
        self,
        tensordict: TensorDictBase,
        tensordict_reset: TensorDictBase,
    ) -> TensorDictBase:
        if self.traffic is not None:
            self._begin(tensordict_reset["timestep"][:, 0] == 0)
        written = self._write(tensordict_reset)
        key = ("traffic", "plan")
        first = tensordict is None or key not in tensordict.keys(True)
        if self.traffic is not None and first:
            # A collector would stack it; it is constant velocity, which is also the
            # default without a plan.
            del written[key]
        return written

    def _begin(self, first: Tensor) -> None:
        """Reset the traffic method's state and the plan in environments first [B] bool,
        which have just been reset."""
        env = self._env
        rows = first.nonzero()[:, 0]
        world = env.world()
        drawn = self._drawn[rows.cpu()]
        begins = not len(self._planned_at)
        whole = begins or len(rows) == len(first)
        options = {}
        if self._method.follows_decisions:
            options["decisions"] = self.pool.decisions[drawn].to(env.device)
        fresh = self._method.reset(
            world.scene if whole else world.scene[rows],
            self.pool.seed[drawn].to(env.device),
            self.pool.eta[drawn].to(env.device),
            **options,
        )
        self._state = fresh if whole else put_rows(self._state, rows, new=fresh)
        if begins:
            shape = (*world.scene["route_log"].shape, HORIZON, 4)
            self._plan = torch.zeros(shape, device=env.device)
            self._planned_at = torch.zeros_like(world.step)
        self._plan[rows] = keep_velocity(world.states[rows, : self._plan.shape[1]])
        self._planned_at[rows] = -REPLAN_STEPS

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Before a step: replan the live traffic of environments in which a replan is
        due."""
        if self.traffic is not None:
            step = tensordict["timestep"][:, 0]
            live = (self.pool.source[self._drawn] == LIVE).to(step.device)
            rows = (live & (step - self._planned_at >= REPLAN_STEPS)).nonzero()[:, 0]
            if len(rows):
                self._replan(rows, tensordict.get(("ego", "plan"), None))
        return tensordict

    @torch.no_grad()
    def _replan(self, rows: Tensor, ego_plan: Tensor | None) -> None:
        """New plans of environments rows [b], written into the environment's traffic."""
        world = self._env.world()
        if ego_plan is None:
            if self._method.knowledge == "plan":
                raise InputError(
                    'the policy writes no ("ego", "plan"), which this traffic is told '
                    "(synthesizer.knowledge=plan): drive with an EgoPolicy, write the "
                    "plan, or set synthesizer.knowledge=predicted"
                )
            ego_plan = keep_velocity(world.states[:, 0])  # nobody is told it
        planned_at = world.step[rows]
        state = self._state
        whole = len(rows) == len(world.step)
        if not whole:
            state = take_rows(state, rows)
            world = take_rows(world, rows)
            ego_plan = ego_plan[rows]
        options = {}
        if self._method.queries_ego and self.ego is not None:
            options["react"] = Lookahead(self.ego, world)
        with renumbered(rows):
            state, plan = self._method.replan(state, world, ego_plan, **options)
        self._state = state if whole else put_rows(self._state, rows, new=state)
        self._plan[rows] = plan.states.to(self._plan.dtype)
        if self.on_plan is not None:
            self.on_plan(plan)
        self._planned_at[rows] = planned_at
        self._env.write_traffic(rows, plan.states, plan.present)

    def _step(
        self,
        tensordict: TensorDictBase,
        next_tensordict: TensorDictBase,
    ) -> TensorDictBase:
        return self._write(next_tensordict)

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the transform's keys."""
        device = self._env.device
        keys = {"row": self._drawn[:, None].to(device, copy=True)}
        if self.traffic is not None:
            keys["plan"] = self._plan_from(tensordict["timestep"][:, 0])
            replayed = (self.pool.source[self._drawn] != LIVE).to(device)
            if bool(replayed.any()):
                states = self._env.world().states[:, : self._plan.shape[1]]
                going_on = keep_velocity(states)
                replayed = replayed[:, None, None, None]
                keys["plan"] = torch.where(replayed, going_on, keys["plan"])
        tensordict["traffic"] = TensorDict(
            keys,
            batch_size=tensordict.batch_size,
            device=device,
        )
        return tensordict

    def _plan_from(self, step: Tensor) -> Tensor:
        """States [B, V, H, 4] planned for the steps after `step` [B]; the last state is
        held."""
        age = (step - self._planned_at.clamp(min=0)).clamp(min=0)
        ahead = age[:, None] + torch.arange(HORIZON, device=age.device)
        ahead = ahead.clamp(max=HORIZON - 1)
        if bool((age == age[0]).all()):  # as where all scenes are replanned together
            return self._plan.index_select(2, ahead[0])
        row = torch.arange(len(age), device=age.device)[:, None]
        return self._plan.transpose(1, 2)[row, ahead].transpose(1, 2)

    def _post_step_mdp_hooks(
        self,
        tensordict: TensorDictBase,
        tensordict_: TensorDictBase,
    ):
        """Pass the plan (0.8 kB per vehicle and step) to the policy only, without a
        spec and not stacked over time."""
        if self.traffic is not None:
            tensordict_["traffic", "plan"] = tensordict["next", "traffic", "plan"]
            for key in (("traffic", "plan"), ("next", "traffic", "plan")):
                if key in tensordict.keys(True):
                    del tensordict[key]
        return tensordict, tensordict_

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declares the ("traffic", ...) keys."""
        env = self._env
        row = Unbounded((*env.batch_size, 1), dtype=torch.int64, device=env.device)
        observation_spec["traffic"] = Composite(
            row=row,
            shape=env.batch_size,
            device=env.device,
        )
        return observation_spec
