"""An ego as a TorchRL policy: what it is shown, what it answers, what is refused."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.ego_errors import (
    BY_EGO,
    PlannerExited,
    TrafficNotFinite,
    Undrivable,
)
from e2rl.planners.plausibility import action_faults, checked_answer, plan_faults
from e2rl.sim.world import World, without_future


def from_outside(ego: Ego) -> bool:
    """Whether the class of the ego is not e2rl's own."""
    return not type(ego).__module__.startswith("e2rl.")


def ask(
    ego: Ego,
    method: str,
    world: World,
    *,
    inputs: tuple[Tensor, ...] = (),
    scene: TensorDictBase | None = None,
) -> Any:
    """Returns what a method of the ego returns; one from outside the package is given
    copies.

    Args:
        ego: who is asked.
        method: its method's name.
        world: the first argument of the method.
        inputs: its other arguments.
        scene: `without_future` of the world's scene, where it is made already.

    Raises:
        PlannerExited: it ends the program.
    """
    answer = getattr(ego, method)
    if from_outside(ego) and answer.__module__ != Ego.__module__:
        world = world.shown(scene)
        inputs = tuple(value.clone() for value in inputs)
    try:
        return answer(world, *inputs)
    except SystemExit as error:
        raise PlannerExited(f"it called sys.exit({error.code!r})") from error


@contextmanager
def answering(world: World) -> Iterator[None]:
    """Notes on what is raised within that it is the ego's, which is asked about a
    world.

    Raises TrafficNotFinite instead where the other vehicles of that world are NaN or
    infinite: no ego can answer then.
    """
    try:
        yield
    except Exception as error:
        finite = world.states[:, 1:].isfinite().all(-1) | ~world.valid[:, 1:]
        if rows := _rows(~finite.all(1)):
            why = "a vehicle of the traffic is NaN or infinite"
            raise TrafficNotFinite(why, dict.fromkeys(rows, why)) from error
        error.add_note(BY_EGO)
        raise


def _rows(mask: Tensor) -> list[int]:
    return mask.nonzero()[:, 0].tolist()


class EgoPlanner(TensorDictModuleBase):
    """Writes the plan of an Ego in a DrivingEnv with `agents=True`: ("ego", "plan") [B,
    PLAN_STEPS, 4].

    Plans every `replan_every` steps; in between, the key holds the rest of the last
    plan, its last state held. Reads timestep, agents and, if present, the traffic's
    plan.
    """

    in_keys = ["timestep", "agents"]
    out_keys: list[str | tuple[str, str]] = [("ego", "plan")]

    def __init__(self, ego: Ego, env) -> None:
        """env: the DrivingEnv (or a TransformedEnv around it) in which the ego drives."""
        super().__init__()
        base = getattr(env, "base_env", env)
        self.ego = ego
        self.scene = base.scene
        self.bounds = base.action_spec.space
        self._outside = from_outside(ego)
        self._visible: TensorDictBase | None = None  # scenes, as shown to an outsider
        start = self.scene["start"][:, :1]
        self._plan = torch.zeros_like(start).repeat(1, 1 + PLAN_STEPS, 1)
        self._planned_at = torch.full(
            start.shape[:1],
            -PLAN_STEPS,
            device=start.device,
        )  # step [B] of the last plan, which begins with the state then

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        world = World.of(tensordict, self.scene)
        with answering(world):
            tensordict["ego", "plan"] = self.plan(world)[:, 1:]
        return tensordict

    def plan(self, world: World) -> Tensor:
        """States [B, 1 + PLAN_STEPS, 4] now and at the coming steps of the last plan;
        replans where due."""
        if bool((world.step == 0).any()):
            self._visible = without_future(self.scene) if self._outside else None
            ask(
                self.ego,
                "reset",
                world,
                scene=self._visible,
            )
        age = world.step - self._planned_at
        due = (age >= self.ego.replan_every) | (age < 0) | (world.step == 0)
        if bool(due.any()):
            state = world.states[:, 0]
            shape = (len(state), PLAN_STEPS, 4)
            fresh = self._answer(
                "plan",
                world,
                shape=shape,
            ).to(state)
            self._refuse(plan_faults(state, fresh), due)
            fresh = torch.cat([world.states[:, :1], fresh], 1)
            self._plan = torch.where(due[:, None, None], fresh, self._plan)
            self._planned_at = torch.where(due, world.step, self._planned_at)
        step = torch.arange(1 + PLAN_STEPS, device=world.step.device)
        index = (world.step - self._planned_at)[:, None] + step
        index = index.clamp(max=PLAN_STEPS)[..., None].expand(-1, -1, 4)
        return self._plan.gather(1, index)

    def _answer(
        self,
        method: str,
        world: World,
        *,
        shape: tuple[int, ...],
        inputs: tuple[Tensor, ...] = (),
    ) -> Tensor:
        return checked_answer(
            ask(
                self.ego,
                method,
                world,
                inputs=inputs,
                scene=self._visible,
            ),
            self.ego,
            method=method,
            shape=shape,
            begins=bool((world.step == 0).all()),
        )

    def _refuse(self, faults: Iterable[tuple[Tensor, str]], rows: Tensor) -> None:
        """Raises Undrivable for the first faults among rows [B] bool of an ego from
        outside the package."""
        for wrong, why in faults if self._outside else ():
            if bool((wrong & rows).any()):
                raise Undrivable(why, dict.fromkeys(_rows(wrong & rows), why))


class EgoPolicy(EgoPlanner):
    """An Ego as a TorchRL policy: writes its plan and the "action" [B, 2], within the
    action's bounds."""

    in_keys = ["observation", "timestep", "agents"]
    out_keys = ["action", ("ego", "plan")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        world = World.of(tensordict, self.scene)
        with answering(world):
            plan = self.plan(world)
            inputs = (tensordict["observation"], plan)
            action = self._answer(
                "act",
                world,
                shape=(len(plan), 2),
                inputs=inputs,
            )
            faults = action_faults(world.states[:, 0], plan[:, 1:], action)
            self._refuse(faults, world.step >= 0)
        tensordict["action"] = action.clamp(self.bounds.low, self.bounds.high)
        tensordict["ego", "plan"] = plan[:, 1:]
        return tensordict
