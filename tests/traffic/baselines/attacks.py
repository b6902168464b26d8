"""Baselines on a small random prior, and one replan of theirs taken apart."""

from dataclasses import replace

from e2rl.prior.sde import SamplerSettings
from e2rl.sim.world import World
from e2rl.traffic.baselines.baseline import Baseline
from e2rl.traffic.baselines.cat import CAT
from e2rl.traffic.baselines.ccdiff import CCDiff
from e2rl.traffic.baselines.ctg import CTG, CTGAdv
from e2rl.traffic.baselines.diffscene import DiffScene
from e2rl.traffic.baselines.safe_sim_opt import SafeSimOpt
from e2rl.traffic.baselines.strive import Strive
from e2rl.traffic.baselines.view import View
from e2rl.traffic.nominal import Replan
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import EGO, begin

SMALL = {  # few samples and iterations, so that tests are fast
    "ctg": (CTG, {"samples": 2}),
    "ctg_adv": (CTGAdv, {"samples": 2}),
    "safe_sim_opt": (SafeSimOpt, {"samples": 2}),
    "ccdiff": (CCDiff, {"samples": 2, "controlled": 2}),
    "diffscene": (DiffScene, {"samples": 2}),
    "cat": (CAT, {"samples": 8, "tracks": 2, "spread": 3.0}),
    "strive": (Strive, {"iterations": 3}),
}
ADVERSARIES = [name for name in SMALL if name != "ctg"]


def baseline(name: str, steps: int = 4, **settings) -> Baseline:
    """A baseline of SMALL with the settings of its file but for those given."""
    kind, few = SMALL[name]
    return kind(
        small_prior(0, sampler=SamplerSettings(steps=steps)), **(few | settings)
    )


def first_replan(on: Baseline, scene, eta: float = 2.0):
    """The arguments of `attack` at the first replan of scenes [B] (a Replan and its
    Context), and their View."""
    world = World.at_start(scene)
    state = begin(on, scene, eta=eta)
    ego_plan = EGO.plan(world)
    state = replace(state, lane=on.lane_now(state, world, ego_plan))
    context = on.encode(state, world, ego_plan)
    replan = Replan(
        state,
        world,
        ego_plan=ego_plan,
        noise=on.noise(state),
    )
    return (replan, context), View.of(replan, context, on.strength(state))
