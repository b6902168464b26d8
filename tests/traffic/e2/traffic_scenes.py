"""Short episodes on the synthetic road whose ego has somebody to meet, and everything
needed to run them."""

from dataclasses import replace

import torch
from tensordict import TensorDictBase

from e2rl.planners.ego import Ego
from e2rl.planners.idm_planner import IDMEgo
from e2rl.prior.sde import SamplerSettings
from e2rl.scenes.scene import SceneSet
from e2rl.sim.rollouts import Rollouts
from e2rl.sim.settings import SimSettings
from e2rl.sim.world import World
from e2rl.traffic.e2.e2 import E2
from e2rl.traffic.rollout import roll_out
from e2rl.traffic.traffic import REPLAN_STEPS, State, Traffic, TrafficPlan
from tests.prior.small import small_prior
from tests.synthetic import make_scenes

VEHICLES = [
    (0, 0, 10.0),
    (22, 0, 9.0),
    (10, 1, 10.0),
    (-20, 0, 11.0),
    (45, 1, 8.0),
    (70, 0, 0.0),
]
ROWS = 8
EGO = IDMEgo()


def scenes(count: int = 3, steps: int = 20, **options) -> SceneSet:
    """The ego between others in two lanes; vehicle 1 is ahead of it, vehicle 5 is
    parked far ahead."""
    return make_scenes(
        count,
        vehicles=VEHICLES,
        steps=steps,
        max_vehicles=ROWS,
        max_agents=ROWS + 2,
        **options,
    )


def synthesizer(seed: int = 0, steps: int = 4, sampler: str = "ddim", **settings) -> E2:
    """e2 on a small random prior of `steps` denoising steps."""
    return E2(
        small_prior(
            seed, sampler=SamplerSettings(sampler=sampler, steps=steps, spacing="level")
        ),
        **settings,
    )


def drive(
    scene_set: SceneSet,
    on: Traffic,
    eta: float,
    seeds=None,
    ego: Ego | None = None,
    **sim,
) -> Rollouts:
    """Rollouts of every scene once."""
    index = torch.arange(len(scene_set))
    seeds = index if seeds is None else torch.tensor(seeds)
    etas = torch.full((len(index),), eta)
    return roll_out(
        scene_set,
        index,
        seed=seeds,
        eta=etas,
        ego=ego or EGO,
        traffic=on,
        sim=SimSettings(**sim),
    )


def begin(on: Traffic, scene: TensorDictBase, eta: float = 0.0, seeds=None) -> State:
    """The method's state of new episodes in scenes [B]."""
    count = len(scene)
    seeds = torch.arange(count) if seeds is None else torch.tensor(seeds)
    return on.reset(scene, seeds, torch.full((count,), eta))


def replanned(
    on: Traffic, scene: TensorDictBase, eta: float = 0.0, seeds=None, times: int = 1
):
    """State and plan after `times` replans, half a second of perfect execution between
    two of them."""
    state = begin(on, scene, eta=eta, seeds=seeds)
    world = World.at_start(scene)
    for _ in range(times):
        ego_plan = EGO.plan(world)
        state, plan = on.replan(state, world, ego_plan)
        world = executed(world, plan, ego_plan=ego_plan)
    return state, plan


def executed(world: World, plan: TrafficPlan, ego_plan: torch.Tensor) -> World:
    """The World half a second on, everybody where it planned to be."""
    states = world.states.clone()
    vehicles = plan.states.shape[1]
    states[:, :vehicles] = plan.states[:, :, REPLAN_STEPS - 1]
    states[:, 0] = ego_plan[:, REPLAN_STEPS - 1]
    return replace(world, step=world.step + REPLAN_STEPS, states=states)
