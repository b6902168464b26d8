"""The kernels of rollouts: what `compile` of a configuration means, before the first rollout."""

import sys

from omegaconf import DictConfig
from tqdm import tqdm

from e2rl.metrics import preventable
from e2rl.planners import lane_graph_planner
from e2rl.prior import bounds, features, lane_relative
from e2rl.prior.denoiser import DenoiserSettings, estimate_kernel
from e2rl.run.errors import InputError
from e2rl.run.kernels import KERNELS, Kernel, check_compiler, has_compiler, switch
from e2rl.run.processes import cores, in_processes
from e2rl.sim import leaders
from e2rl.traffic.e2 import foresight, interception

MODULES = (bounds, features, foresight, interception, lane_graph_planner, lane_relative, leaders, preventable)


def prepare_kernels(config: DictConfig) -> None:
    """Switch kernels on or off as `compile` says, and write what auto means here into the configuration.

    auto: on where all are compiled on this machine already. Raises InputError for another value, and where kernels are
    to be compiled and there is no compiler.
    """
    if config.compile not in ("auto", True, False):
        raise InputError(f"compile={config.compile}: choose one of auto, true, false")
    names = {module.__name__ for module in MODULES}
    found = [each for each in KERNELS.values() if each.function.__module__ in names]
    missing = [each for each in (*found, estimate_kernel(DenoiserSettings())) if not each.file.exists()]
    on = config.compile is not False and config.device == "cpu"
    if on and missing and config.compile == "auto":
        on = False
        if has_compiler():
            told = f"compile=true compiles the {len(missing)} kernels of rollouts, once; then these take half the time"
            print(told, file=sys.stderr)
    elif on and missing:
        check_compiler("compile")
        done = in_processes(Kernel.compile, missing, cores(), lambda each: 1.0)
        for _ in tqdm(done, "kernels", len(missing), unit="kernel", disable=None):
            pass
    if config.compile == "auto":
        config.compile = on
    switch(on)
