"""The extension point for traffic: recordings, car-following, the prior, e2 and the
baselines.

A method is a class with one or two methods, and a YAML file in conf/synthesizer with
its `_target_`, a `name` and its settings. A complete example, in which every vehicle
brakes to a halt:

    class Halt(Traffic):
        def __init__(self, prior=None, braking: float = 2.0):
            self.braking = braking

        def replan(self, state, world, ego_plan):
            now = world.states[:, : world.scene["route_log"].shape[1], None]        # [B, V, 1, 4]
            time = DT * torch.arange(1, HORIZON + 1, device=now.device)              # [H]
            time = torch.minimum(time, now[..., 3] / self.braking)  # [B, V, H]
            distance = now[..., 3] * time - self.braking * time**2 / 2
            heading = now[..., 2].expand_as(distance)
            ahead = torch.stack([heading.cos(), heading.sin()], -1)
            xy = now[..., :2] + distance[..., None] * ahead
            rest = torch.stack([heading, now[..., 3] - self.braking * time], -1)
            present = world.valid[:, : distance.shape[1], None].expand_as(distance)
            return state, TrafficPlan(torch.cat([xy, rest], -1), present)
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.prior.lane_relative import HORIZON
from e2rl.prior.prior import Prior
from e2rl.run.config import Extension
from e2rl.scenes.boxes import unit_vectors
from e2rl.scenes.recording import DT
from e2rl.sim.world import World

REPLAN_STEPS = 5  # steps of DT between two replans: 0.5 s, for every method
POINT_STEPS = (
    5  # steps between two points of a plan that are kept in a rollout's file: 0.5 s
)
# Of B running scenes: a tensor, a TensorDict or a (nested) dataclass of them, batch
# first; or None.
State = Any


@dataclass
class TrafficPlan:
    """Planned motion of the vehicles of B scenes over the coming HORIZON steps. Outputs
    that are None do not apply.

    states [B, V, HORIZON, 4]: the ego's row is ignored; present [B, V, HORIZON] bool:
    false from the step on at which a vehicle has left; adversary [B, V] bool: under
    adversarial control; target [B, V] int64: whom each vehicle under control acts on, 0
    the ego, -1 nobody; route [B, V] int64: route candidates followed, -1 none (None:
    the recorded ones); path_kl, anchor_jump [B, V]: discrete path KL of the control,
    and energy of the anchoring, since the start.
    """

    states: Tensor
    present: Tensor
    adversary: Tensor | None = None
    path_kl: Tensor | None = None
    route: Tensor | None = None
    target: Tensor | None = None
    anchor_jump: Tensor | None = None


class Traffic(Extension, ABC):
    """Drives all vehicles but the ego of B scenes at once. Built as
    `_target_(prior=prior, **settings)`.

    adversarial: the intensity eta matters; follows_decisions: `reset` takes decisions
    [B, D] (e2rl/traffic/decisions.py; None: by rule); queries_ego: `replan` takes
    `react`, which returns the ego's states against a plan: react(rows [G] of the batch,
    states [G, V, HORIZON, 4]) -> [G, HORIZON, 4]; knowledge, responsibility: what it
    knows of the ego and owes it, in
    words for captions ("": nothing to say); tuned: ranges (low, high[, "log"]) of the
    settings that a tuning varies, by dotted name, the gain first.
    """

    adversarial = False
    follows_decisions = False
    queries_ego = False
    knowledge = ""
    responsibility = ""
    tuned: Mapping[str, tuple] = {}

    def __init__(self, prior: Prior | None = None) -> None:  # noqa: B027
        """prior: the frozen prior of the run; methods without a prior ignore it."""

    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor) -> State:
        """Returns the state of new episodes in scenes [B], with noise seeds [B] int64
        and intensities eta [B]."""
        return None

    @abstractmethod
    def replan(
        self,
        state: State,
        world: World,
        ego_plan: Tensor,
    ) -> tuple[State, TrafficPlan]:
        """Returns the new state and plan.

        Called every REPLAN_STEPS steps; the first REPLAN_STEPS steps of a plan are
        executed unchanged.

        Args:
            state: what `reset` or the last replan returned.
            world: the B scenes now.
            ego_plan: [B, >= HORIZON, 4], states that the ego announces, for a method
                whose knowledge is its plan.
        """


def keep_velocity(states: Tensor, steps: Tensor | None = None) -> Tensor:
    """Returns states [..., H, 4] of agents [..., 4] after `steps` [H] (or [..., H])
    steps at constant velocity; default 1..HORIZON."""
    steps = (
        torch.arange(1, HORIZON + 1, device=states.device) if steps is None else steps
    )
    distance = states[..., 3, None] * DT * steps
    direction = unit_vectors(states[..., 2])[..., None, :]
    xy = states[..., None, :2] + distance[..., None] * direction
    return torch.cat([xy, states[..., None, 2:].expand(*xy.shape[:-1], 2)], -1)


def steps_ahead(world: World) -> Tensor:
    """Returns the coming simulated steps [B, HORIZON] int64."""
    return world.step[:, None] + torch.arange(1, HORIZON + 1, device=world.step.device)


class PlanLog:
    """Collects the plans of B scenes that replan at the same steps, every REPLAN_STEPS
    from the start on.

    `last`: the plan that came last; `acted` [B, V] bool: who has been an adversary in
    any plan.
    """

    last: TrafficPlan

    def __init__(self) -> None:
        self.paths: list[Tensor] = []
        self.targets: list[Tensor] = []
        self.acted = torch.zeros(1, 1, dtype=torch.bool)

    def __call__(self, plan: TrafficPlan) -> None:
        """Notes a plan of all scenes (`AdversarialSynthesizer.on_plan`)."""
        nobody = torch.full(plan.states.shape[:2], -1, dtype=torch.int64)
        self.paths.append(points_of(plan.states).cpu())
        self.targets.append(nobody if plan.target is None else plan.target.cpu())
        acts = nobody >= 0 if plan.adversary is None else plan.adversary.cpu()
        self.acted = self.acted | acts
        self.last = plan

    def plans(self, ego_plans: Tensor) -> dict[str, Tensor]:
        """Returns plans [B, R, V, K, 2] m, at POINT_STEPS, 2 POINT_STEPS .. steps after
        each of R replans, and targets [B, R, V] (0 the ego, -1 nobody). ego_plans [B,
        T, H, 4], of every step, become row 0."""
        plans = torch.stack(self.paths, 1)
        plans[:, :, 0] = points_of(ego_plans[:, ::REPLAN_STEPS]).cpu()
        return {"plans": plans, "targets": torch.stack(self.targets, 1)}

    def routes(self, scene: TensorDictBase) -> Tensor:
        """Returns the route candidates [B, V] int64 that were followed last; by default
        the recorded ones."""
        return (
            scene["route_log"].clamp(min=0)
            if self.last.route is None
            else self.last.route
        )

    def transport(self) -> dict[str, Tensor]:
        """Returns what control cost each rollout [B]: path KL of adversaries and of
        others, energy of anchoring."""
        zero = torch.zeros(self.acted.shape)
        acted = self.acted
        kl, jump = (
            zero if value is None else value.cpu()
            for value in (self.last.path_kl, self.last.anchor_jump)
        )
        costs = {"adversary": kl * acted, "others": kl * ~acted, "anchor": jump}
        return {f"transport_{name}": value.sum(-1) for name, value in costs.items()}


def points_of(states: Tensor) -> Tensor:
    """Returns the positions [..., K, 2] of states [..., H, 4] at every POINT_STEPS-th
    planned step."""
    return states[..., POINT_STEPS - 1 :: POINT_STEPS, :2]


@contextmanager
def counted_nfe(traffic: Traffic) -> Iterator[list[int]]:
    """Yields the NFE of a method within the block, one number per call of the prior's
    network: its joint samples, twice where a gradient is wanted."""
    nfe = list[int]()
    prior = getattr(traffic, "prior", None)
    if not isinstance(prior, Prior):
        yield nfe
        return
    hook = prior.denoiser.register_forward_hook(
        lambda _, given, x0: nfe.append(len(x0) * (1 + x0.requires_grad))
    )
    try:
        yield nfe
    finally:
        hook.remove()
