"""One interface for whoever drives: planners, learned actors and outside code, in collection and evaluation alike.

An outside planner plugs in by Hydra's `_target_`, in a YAML file of its own in conf/ego that lists its arguments. This
one is whole: it holds the ego's speed along its mission for the coming five seconds.

    import torch
    from e2rl.ego.base import PLAN_STEPS, Ego
    from e2rl.ego.path import MissionPath


    class Cruise(Ego):
        def __init__(self, replan_every: int = 5, gain: float = 1.0) -> None:
            super().__init__(replan_every)
            self.gain = gain

        def plan(self, world):
            path = MissionPath(world)                                 # the ego's route, projected on
            speed = world.states[:, 0, 3:] * self.gain                # [B, 1] m/s
            return path.drive(speed.expand(-1, PLAN_STEPS + 1))       # [B, 50, 4] x, y, heading, speed

`plan` is all that it must have: `act` tracks the plan. An ego that maps observations to actions overrides `act` and
plans by whatever it expects of itself.
"""

from abc import ABC, abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from e2rl.errors import InputError
from e2rl.scene.boxes import to_frame
from e2rl.sim import dynamics
from e2rl.sim.world import World

PLAN_STEPS = 50  # H: planned steps of DT
RETURN_TIME, RETURN_LENGTH = 0.7, 1.5  # s, m: a lateral error decays over max(RETURN_LENGTH, RETURN_TIME * v)
CATCH_UP = 1.0  # 1/s: rate at which an error along the plan is made good


class Ego(ABC):
    """Drives the ego of B scenes at once. `plan` is a pure function of the World; `act` follows it."""

    def __init__(self, replan_every: int = 5) -> None:
        """replan_every: steps between two plans (5 is 2 Hz, 1 every step), at most PLAN_STEPS."""
        if not 1 <= replan_every <= PLAN_STEPS:
            raise InputError(f"ego.replan_every={replan_every}: choose 1 to {PLAN_STEPS} steps")
        self.replan_every = int(replan_every)
        self._planned: tuple[Tensor, Tensor] | None = None  # start of each plan and its states; step of planning
        self._announced: tuple[World, Tensor] | None = None  # the moment and the plan

    def reset(self, world: World) -> None:
        """Called after every reset; the scenes whose world.step is 0 begin anew. An ego with memory clears it here."""
        if self._planned is not None and len(self._planned[1]) != len(world.step):
            self._planned = None

    @abstractmethod
    def plan(self, world: World) -> Tensor:
        """Planned states [B, PLAN_STEPS, 4] of the egos at steps 1.. from now, 0.1 s apart, without side effects."""

    def announce(self, world: World) -> Tensor:
        """`plan`, for whoever plans against the ego; planning anew at the same moment, `act` drives it."""
        self._announced = world, self.plan(world)
        return self._announced[1]

    def _fresh(self, world: World) -> Tensor:
        """The announced plan if it was made at this moment, else a new one."""
        if self._announced is not None:
            then, plan = self._announced
            if all(torch.equal(getattr(then, name), getattr(world, name)) for name in ("step", "states", "valid")):
                return plan
        return self.plan(world)

    def act(self, world: World, observation: Tensor | None = None) -> Tensor:
        """Action [B, 2] (acceleration, yaw rate) for the next step.

        observation [B, D]: the environment's, for egos that want it (planners read the world).
        """
        state, row = world.states[:, 0], torch.arange(len(world.step), device=world.step.device)
        if self._planned is None or self.replan_every == 1:
            self._planned = (torch.cat([state[:, None], self._fresh(world)], 1), world.step.clone())
        else:
            states, since = self._planned
            age = world.step - since
            due = (age >= self.replan_every) | (age < 0) | (world.step == 0)
            if due.any():
                fresh = torch.cat([state[:, None], self._fresh(world)], 1)
                states = torch.where(due[:, None, None], fresh, states)
                self._planned = (states, torch.where(due, world.step, since))
        states, since = self._planned
        age = world.step - since
        return track(state, states[row, age], states[row, age + 1])


def return_length(speed: Tensor) -> Tensor:
    """Metres over which a lateral error decays at speed [...] m/s."""
    return (RETURN_TIME * speed).clamp(min=RETURN_LENGTH)


def track(state: Tensor, planned: Tensor, following: Tensor) -> Tensor:
    """Action [..., 2] that leads a vehicle at state [..., 4] to follow a plan: `planned` now, `following` one step on.

    Inverse dynamics to the following speed and heading, corrected by the deviation from the plan: a lateral error turns
    the aimed heading towards the plan, an error along it changes the aimed speed. A plan that obeys the unicycle is
    followed without error.
    """
    error = to_frame(state[..., :2], planned)
    heading = following[..., 2] - torch.atan(error[..., 1] / return_length(state[..., 3]))
    speed = (following[..., 3] - CATCH_UP * error[..., 0]).clamp(min=0)
    aimed = torch.cat([following[..., :2], torch.stack([heading, speed], -1)], -1)
    return dynamics.inverse(torch.stack([state, aimed], -2))[..., 0, :]


class EgoPolicy(TensorDictModuleBase):
    """An Ego as a TorchRL policy of one environment: reads its world (and "observation"), writes "action"."""

    in_keys = ["observation"]
    out_keys = ["action"]

    def __init__(self, ego: Ego, env) -> None:
        """env: a DrivingEnv, or a TransformedEnv around one."""
        super().__init__()
        self.ego = ego
        self._env = (getattr(env, "base_env", env),)  # in a tuple: the policy must not own the environment as a module
        self._resets = -1

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        env = self._env[0]
        world = env.world()
        if env.resets != self._resets:
            self.ego.reset(world)
            self._resets = env.resets
        spec = env.action_spec
        action = self.ego.act(world, tensordict.get("observation", None))
        tensordict["action"] = action.clamp(spec.space.low, spec.space.high)
        return tensordict
