"""The extension point for traffic: recordings, car-following, the prior, e2 and its rivals.

A method is a class with one or two methods, and a YAML file in conf/synthesizer with its `_target_`, a `name` and its
settings. A complete example, in which every vehicle brakes to a halt:

    class Halt(Traffic):
        stochastic = False

        def __init__(self, prior=None, braking: float = 2.0):
            self.braking = braking

        def replan(self, state, world, ego_plan):
            now = world.states[:, : world.scene["route_log"].shape[1], None]        # [B, V, 1, 4]
            time = DT * torch.arange(1, HORIZON + 1, device=now.device)              # [H]
            time = torch.minimum(time, now[..., 3] / self.braking)                   # [B, V, H], until the halt
            way = now[..., 3] * time - self.braking * time**2 / 2
            xy = now[..., :2] + way[..., None] * torch.stack([now[..., 2].cos(), now[..., 2].sin()], -1)
            rest = torch.stack([now[..., 2].expand_as(way), now[..., 3] - self.braking * time], -1)
            present = world.valid[:, : way.shape[1], None].expand_as(way)
            return state, TrafficPlan(torch.cat([xy, rest], -1), present)

Causal templates of an attack: who may act on the ego directly, and who from afar through others.

`single`: one vehicle acts on the ego; `pair`: two do; `chain`: one does, and one more acts on it from afar, through
others where need be; `full`: as many as the traffic method is set to. Tensors hold them as codes, the places in
TEMPLATES.

The plans of a rollout, thinned out for its file: where everybody meant to go, and whom adversaries aimed at.

Passes of the prior's network: what a method costs, whatever the machine.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from e2rl.prior.lane_relative import HORIZON
from e2rl.prior.prior import Prior
from e2rl.run.config import Extension
from e2rl.scenes.recording import DT
from e2rl.sim.world import World

TEMPLATES = ("single", "pair", "chain", "full")
SINGLE, PAIR, CHAIN, FULL = range(len(TEMPLATES))


REPLAN_STEPS = 5  # steps of DT between two replans: 0.5 s, for every method
State = Any  # of B running scenes: a tensor, a TensorDict or a (nested) dataclass of them, batch first; or None


@dataclass
class TrafficPlan:
    """Planned motion of the vehicles of B scenes over the coming HORIZON steps.

    states [B, V, HORIZON, 4] (the ego's row is ignored); present [B, V, HORIZON] bool: false from the step on at which
    a vehicle has left; adversary [B, V] bool: under adversarial control (None: no vehicle); path_kl [B, V]: discrete
    path KL of the control since the start (None: 0); route [B, V] int64: route candidates followed, -1 none (None: the
    recorded ones); target [B, V] int64: whom each vehicle under control acts on, 0 the ego, -1 nobody (None: nobody);
    figures {name: [B, V]}: further outputs of a method, written under ("traffic", name).
    """

    states: Tensor
    present: Tensor
    adversary: Tensor | None = None
    path_kl: Tensor | None = None
    route: Tensor | None = None
    target: Tensor | None = None
    figures: dict[str, Tensor] = field(default_factory=dict)


class Traffic(Extension, ABC):
    """Drives all vehicles but the ego of B scenes at once. Built as `_target_(prior=prior, **settings)`.

    stochastic: seeds matter; adversarial: the intensity eta matters; follows_template: `reset` takes causal templates,
    template [B] int64 (e2rl/traffic/traffic.py; None: full for all); predicts: plans can be compared with the log in
    open loop; replays_log: it is the recording itself; queries_ego: `replan` takes `react`, which returns the ego's
    states against a plan: react(rows [G] of the batch, states [G, V, HORIZON, 4]) -> [G, HORIZON, 4];
    knowledge, responsibility: what it knows of the ego and owes it, in words for captions ("": nothing to say);
    figures: names of the further outputs of its plans; on_selection: called with every selection of adversaries;
    topology: the TopologySettings of these selections.
    """

    stochastic = True
    adversarial = False
    follows_template = False
    predicts = True
    replays_log = False
    queries_ego = False
    knowledge = ""
    responsibility = ""
    figures: tuple[str, ...] = ()
    on_selection: Callable[[Any], None] | None = None
    topology: Any = None

    def __init__(self, prior: Prior | None = None) -> None:  # noqa: B027
        """prior: the frozen prior of the run; methods without a prior ignore it."""

    def reset(self, scenes: TensorDictBase, seed: Tensor, eta: Tensor) -> State:
        """State of new episodes in scenes [B], with noise seeds [B] int64 and intensities eta [B]."""
        return None

    @abstractmethod
    def replan(self, state: State, world: World, ego_plan: Tensor) -> tuple[State, TrafficPlan]:
        """New state and plan; ego_plan [B, >= HORIZON, 4]: the states that the ego announces, for a method whose
        knowledge is its plan.

        Called every REPLAN_STEPS steps; the first REPLAN_STEPS steps of a plan are executed unchanged.
        """

    def open_loop_plans(self, scene: TensorDictBase, seed: Tensor) -> Tensor:
        """Joint plans [B, S, V, HORIZON, 4] of scenes [B] from their start frames; seed [S, B] int64.

        By default those of the first replan, given an ego that keeps its velocity.
        """
        world = World.at_start(scene)
        ego_plan = keep_velocity(world.states[:, 0])
        eta = torch.zeros(len(world.step), device=seed.device)
        plans = [self.replan(self.reset(scene, one, eta), world, ego_plan)[1].states for one in seed]
        return torch.stack(plans, 1)


def keep_velocity(states: Tensor, steps: Tensor | None = None) -> Tensor:
    """States [..., H, 4] of agents [..., 4] after `steps` [H] (or [..., H]) steps at constant velocity; default
    1..HORIZON."""
    steps = torch.arange(1, HORIZON + 1, device=states.device) if steps is None else steps
    way = states[..., 3, None] * DT * steps
    direction = torch.stack([states[..., 2].cos(), states[..., 2].sin()], -1)[..., None, :]
    xy = states[..., None, :2] + way[..., None] * direction
    return torch.cat([xy, states[..., None, 2:].expand(*xy.shape[:-1], 2)], -1)


def steps_ahead(world: World) -> Tensor:
    """The coming simulated steps [B, HORIZON] int64."""
    return world.step[:, None] + torch.arange(1, HORIZON + 1, device=world.step.device)


POINT_STEPS = 5  # steps between two kept points of a plan: 0.5 s


class PlanLog:
    """Collects the plans of B scenes that replan at the same steps, every REPLAN_STEPS from the start on."""

    def __init__(self) -> None:
        self.paths: list[Tensor] = []
        self.targets: list[Tensor] = []

    def __call__(self, plan: TrafficPlan) -> None:
        """Note a plan of all scenes (`AdversarialSynthesizer.on_plan`)."""
        nobody = torch.full(plan.states.shape[:2], -1, dtype=torch.int64)
        self.paths.append(points_of(plan.states).cpu())
        self.targets.append(nobody if plan.target is None else plan.target.cpu())

    def tensors(self, ego_plans: Tensor) -> dict[str, Tensor]:
        """`plans` [B, R, V, K, 2] m, at POINT_STEPS, 2 POINT_STEPS .. steps after each of R replans, and `targets`
        [B, R, V] (0 the ego, -1 nobody). Row 0 is the ego's plan, from ego_plans [B, T, H, 4] at every step."""
        plans = torch.stack(self.paths, 1)
        plans[:, :, 0] = points_of(ego_plans[:, ::REPLAN_STEPS]).cpu()
        return {"plans": plans, "targets": torch.stack(self.targets, 1)}


def points_of(states: Tensor) -> Tensor:
    """Positions [..., K, 2] of states [..., H, 4] at every POINT_STEPS-th planned step."""
    return states[..., POINT_STEPS - 1 :: POINT_STEPS, :2]


@dataclass
class Passes:
    """count: passes so far, of a joint sample each; one whose gradient is wanted counts twice."""

    count: int = 0

    def __call__(self, network: nn.Module, inputs: tuple[Tensor, ...], x0: Tensor) -> None:
        """A forward hook of the denoiser."""
        self.count += len(x0) * (2 if x0.requires_grad else 1)


@contextmanager
def counted_passes(traffic: Traffic) -> Iterator[Passes]:
    """The Passes that a method makes within the block; none for a method without a prior."""
    passes, prior = Passes(), getattr(traffic, "prior", None)
    if not isinstance(prior, Prior):
        yield passes
        return
    hook = prior.denoiser.register_forward_hook(passes)
    try:
        yield passes
    finally:
        hook.remove()
