"""The interface of all egos: planners, the learned actor, users' code.

A user's planner is a class and a YAML file in conf/ego with its `_target_` and
arguments (docs/guide/planner.md, examples/). It overrides `plan`, and `act` tracks the
plan; or `act`, which maps observations to actions.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from e2rl.run.config import Extension, check_range
from e2rl.scenes.boxes import to_frame
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.world import World

PLAN_STEPS = 50  # H: planned steps of DT
RETURN_TIME = 0.7  # s at the present speed over which a lateral error decays
RETURN_LENGTH = 1.5  # m over which it decays at least
CATCH_UP = 1.0  # 1/s: rate at which a longitudinal error is corrected


class Ego(Extension):
    """Drives the ego of B scenes at once, by its plans, a pure function of the World,
    or by its actions.

    replan_every: steps between two plans (5 is 2 Hz, 1 every step), at most PLAN_STEPS;
    replays_log: the environment moves this ego along its recording
    (`SimSettings.replay_ego`) and ignores its actions; tuned: what `e2rl tune`
    searches, {argument: (low, high) or (low, high, "log")}.
    """

    replays_log = False
    tuned: ClassVar[Mapping[str, tuple]] = {}

    def __init__(self, replan_every: int = 5) -> None:
        check_range(
            "ego.replan_every",
            replan_every,
            low=1,
            high=PLAN_STEPS,
        )
        self.replan_every = replan_every

    def reset(self, world: World) -> None:  # noqa: B027 - most egos have no memory
        """Called before the first plan of new episodes (world.step 0). An ego with
        memory clears it here."""

    def __new__(cls, *args: Any, **settings: Any) -> "Ego":
        if cls.plan is Ego.plan and cls.act is Ego.act:
            raise TypeError(
                f"{cls.__name__} overrides neither plan nor act, so that it does not drive"
            )
        return super().__new__(cls)

    def plan(self, world: World) -> Tensor:
        """Planned states [B, PLAN_STEPS, 4] of the egos at steps 1.. from now, 0.1 s
        apart, without side effects.

        By default, for an ego that acts, its present velocity held.
        """
        times = DT * torch.arange(1, PLAN_STEPS + 1, device=world.states.device)
        return dynamics.constant_velocity(world.states[:, 0], times)

    def act(
        self,
        world: World,
        observation: Tensor,
        plan: Tensor,
    ) -> Tensor:
        """Action [B, 2] (acceleration [m/s^2], yaw rate [rad/s]) for the next step; by
        default it tracks the plan.

        observation [B, D]: the environment's; plan [B, 1 + PLAN_STEPS, 4]: states of
        the last plan, now and at the coming steps.
        """
        return track(
            world.states[:, 0],
            plan[:, 0],
            following=plan[:, 1],
        )


def return_length(speed: Tensor) -> Tensor:
    """Metres over which a lateral error decays at speed [...] m/s."""
    return (RETURN_TIME * speed).clamp(min=RETURN_LENGTH)


def track(
    state: Tensor,
    planned: Tensor,
    following: Tensor,
) -> Tensor:
    """Action [..., 2] with which a vehicle at state [..., 4] tracks a plan: `planned`
    now, `following` one step later.

    Inverse dynamics to the following speed and heading, corrected by the deviation from
    the plan: a lateral error turns the target heading towards the plan, a longitudinal
    error changes the target speed. A plan that obeys the unicycle is tracked without
    error.
    """
    error = to_frame(state[..., :2], planned)
    correction = torch.atan(error[..., 1] / return_length(state[..., 3]))
    heading = following[..., 2] - correction
    speed = (following[..., 3] - CATCH_UP * error[..., 0]).clamp(min=0)
    target = torch.cat([following[..., :2], torch.stack([heading, speed], -1)], -1)
    return dynamics.inverse(torch.stack([state, target], -2))[..., 0, :]
