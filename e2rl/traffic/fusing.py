"""What `compile` of a configuration means, before the first rollout: the fused functions
of rollouts and learning run compiled."""

import sys
from importlib import import_module

from omegaconf import DictConfig

from e2rl.prior.denoiser import DenoiserSettings, fused_encoding, fused_estimate
from e2rl.prior.lane_relative import SIZE
from e2rl.prior.sde import SamplerSettings, fused_step
from e2rl.run.errors import InputError
from e2rl.run.fused import FUSED, Fused, check_compiler, has_compiler, switch
from e2rl.run.processes import cores, in_processes
from e2rl.run.terminal import Bar

EARNED = 4000  # rollouts of a run that takes twice as long as compiling, or longer
# Importing these registers every fused function of the package.
USERS = (
    "e2rl.traffic.e2.e2",
    "e2rl.planners.lane_graph_planner",
    "e2rl.planners.sampling",
    "e2rl.planners.actor",
    "e2rl.sim.env",
)


def fused_functions() -> list[Fused]:
    """Returns the fused functions of the package, those of the prior's network as
    configured."""
    for module in USERS:
        import_module(module)
    network = DenoiserSettings()
    sampler = SamplerSettings()
    configured = {
        function.name: function
        for function in (
            fused_encoding(network),
            fused_estimate(network),
            fused_step(sampler, SIZE, limited=False),
        )
    }
    registered = {
        name: function for name, function in FUSED.items() if name.startswith("e2rl.")
    }
    return list((registered | configured).values())


def choice_of(config: DictConfig) -> str | bool:
    """Returns the option `compile`; InputError for a value that it does not have."""
    choice = config.get("compile", False)  # the runs of training have none
    if choice not in ("auto", True, False):
        raise InputError(f"compile={choice}: choose one of auto, true, false")
    return choice


def prepare_fused(config: DictConfig, rollouts: float = 0) -> None:
    """Switches fused functions on or off as `compile` says, and writes what auto means
    here into the configuration.

    auto: on where all are compiled on this machine already, or where the run has
    EARNED `rollouts` and there is a compiler. Raises InputError as `choice_of`, and
    where they are to be compiled and there is no compiler.
    """
    choice = choice_of(config)
    missing = [function for function in fused_functions() if not function.file.exists()]
    on = choice is not False and config.device == "cpu"
    if on and missing and choice == "auto":
        on = rollouts >= EARNED and has_compiler()
        if on:
            print(
                f"some {rollouts:,.0f} rollouts: {len(missing)} functions are compiled "
                "first, once on a machine, in some minutes (compile=false does without)",
                file=sys.stderr,
            )
        elif has_compiler():
            print(
                f"not compiled; compile=true would compile {len(missing)} functions, "
                "once, in some minutes, for rollouts in half the time",
                file=sys.stderr,
            )
    if on and missing:
        check_compiler("compile")
        compiled = in_processes(
            Fused.compile,
            missing,
            processes=cores(),
            cost=lambda function: 1.0,
        )
        for _ in Bar(compiled, "compiling", len(missing), unit="function"):
            pass
    if choice == "auto":
        config.compile = on
    switch(on)
