"""The fused functions of rollouts and learning: what `compile` of a configuration
means, before the first rollout."""

import sys

from omegaconf import DictConfig

from e2rl.metrics import preventable
from e2rl.planners import hazard, reference, trunk
from e2rl.prior import bounds, features, free_space, lane_relative, prior, routes
from e2rl.prior.denoiser import DenoiserSettings, fused_encoding, fused_estimate
from e2rl.prior.lane_relative import SIZE
from e2rl.prior.sde import SamplerSettings, fused_step
from e2rl.run.errors import InputError
from e2rl.run.fused import FUSED, Fused, check_compiler, has_compiler, switch
from e2rl.run.processes import cores, in_processes
from e2rl.run.terminal import Bar
from e2rl.scenes import drivable_area, route
from e2rl.sim import leaders, observation, step
from e2rl.traffic.e2 import anchoring, foresight, interception, pull

MODULES = (
    *(
        anchoring,
        bounds,
        drivable_area,
        features,
        foresight,
        free_space,
        interception,
        pull,
    ),
    *(
        hazard,
        lane_relative,
        leaders,
        observation,
        preventable,
        prior,
        reference,
        route,
        routes,
        step,
        trunk,
    ),
)


def prepare_fused(config: DictConfig) -> None:
    """Switch fused functions on or off as `compile` says, and write what auto means
    here into the configuration.

    auto: on where all are compiled on this machine already. Raises InputError for
    another value, and where they are to be compiled and there is no compiler.
    """
    asked = config.get("compile", False)  # runs of earlier versions have none
    if asked not in ("auto", True, False):
        raise InputError(f"compile={asked}: choose one of auto, true, false")
    names = {module.__name__ for module in MODULES}
    found = [each for each in FUSED.values() if each.function.__module__ in names]
    sampler = SamplerSettings()
    network = DenoiserSettings()
    found += fused_encoding(network), fused_estimate(network)
    found.append(fused_step(sampler, SIZE, limited=False))
    missing = [each for each in found if not each.file.exists()]
    on = asked is not False and config.device == "cpu"
    if on and missing and asked == "auto":
        on = False
        if has_compiler():
            told = f"compile=true compiles {len(missing)} functions, once; then rollouts take half the time"
            print(told, file=sys.stderr)
    elif on and missing:
        check_compiler("compile")
        done = in_processes(
            Fused.compile, missing, processes=cores(), cost=lambda each: 1.0
        )
        for _ in Bar(done, "compiling", len(missing), unit="function"):
            pass
    if asked == "auto":
        config.compile = on
    switch(on)
