"""Tuning of an adversary in closed loop: failures found within a budget of off-road driving, above the nominal prior's.

Every method has the same number of trials on the same scenes, seeds and ego, under the same budget. `python evaluate.py
experiment=tune synthesizer=NAME` calls this.
"""

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from tqdm import tqdm

from e2rl.evaluation.protocol import Method, Setup, drive_all
from e2rl.evaluation.rollout_files import require_rows
from e2rl.evaluation.tuning import Parameters
from e2rl.metrics.statistics import summarise
from e2rl.run.processes import Processes
from e2rl.run.settings import check_choice, check_range
from e2rl.traffic.attempt import summary_of
from e2rl.traffic.traffic import Traffic

SOUGHT = ("cfr", "cfr_counted", "cfr_preventable")
MEASURED = (*SOUGHT, "aor_step", "cfr_bg", "real", "real_adv", "passes")
LOST = 0.01  # share of rollouts that may end for an error of the planner or the traffic
NOMINAL = "nominal"  # after a metric's name: its value in the traffic that the budget is held against


@dataclass(frozen=True)
class AttackObjective:
    """seek: of SOUGHT, the share of rollouts that is maximised; off_road: the most `aor_step`, as a share, that a trial
    may have above the nominal traffic; realism: the least `real_adv`, None: any. A method that has no adversary in any
    rollout has no `real_adv`, and keeps every such limit."""

    seek: str = "cfr"
    off_road: float = 0.005
    realism: float | None = None

    def __post_init__(self) -> None:
        check_choice("tuning.objective.seek", self.seek, SOUGHT)
        check_range("tuning.objective.off_road", self.off_road, 0, 1)
        if self.realism is not None:
            check_range("tuning.objective.realism", self.realism, 0, 1)

    def judge(self, metrics: Mapping[str, float], reference: Mapping[str, float]) -> tuple[float, float]:
        """(-share of failures, excess) of a trial's metrics; excess: by how much the limits are missed, 0 for an
        admissible trial, inf for a share that is NaN. reference is not used: each trial has its nominal metrics. A
        trial that loses more than LOST of its rollouts, beyond nominal traffic's, misses a limit: it would be compared
        on other scenes."""
        over = metrics["aor_step"] - metrics[f"aor_step {NOMINAL}"] - self.off_road
        lost = metrics.get("ended", 0.0) - metrics.get(f"ended {NOMINAL}", 0.0) - LOST
        excess = max(0.0, over) + max(0.0, lost)
        if self.realism is not None and not math.isnan(metrics["real_adv"]):
            excess += max(0.0, self.realism - metrics["real_adv"])
        value = -metrics[self.seek]
        return value, math.inf if math.isnan(value) or math.isnan(over) else excess

    def text(self, metrics: Mapping[str, float]) -> str:
        """The metrics of a trial in a few words."""
        over = 100 * (metrics["aor_step"] - metrics[f"aor_step {NOMINAL}"])
        lost = f"; {100 * metrics['ended']:.1f}% ended for an error" if metrics.get("ended") else ""
        found = ", ".join(f"{name} {100 * metrics[name]:.1f}%" for name in dict.fromkeys((self.seek, "cfr_counted")))
        return f"{found}; off the road {over:+.2f} points over nominal; real_adv {metrics['real_adv']:.3f}{lost}"


@dataclass
class AttackTrials:
    """evaluate(parameters) of an adversary: metrics of its rollouts on every scene and seed, and of `nominal`'s."""

    setup: Setup
    nominal: Method
    eta: float
    seeds: Sequence[int]
    make: Callable[[Parameters], Traffic]
    processes: Processes = 1

    def __call__(self, parameters: Parameters) -> dict[str, float]:
        """MEASURED of the adversary, NAME_low and NAME_high of the 95% interval of those of SOUGHT; `NAME nominal` of
        MEASURED in nominal traffic, which is rolled out once."""
        traffic = self.make(parameters)
        return self.measure(Method("trial", traffic, self.eta)) | self.reference

    @cached_property
    def reference(self) -> dict[str, float]:
        known = (*MEASURED, "ended")
        return {f"{name} {NOMINAL}": value for name, value in self.measure(self.nominal).items() if name in known}

    def measure(self, method: Method) -> dict[str, float]:
        """MEASURED of a method, with the intervals of SOUGHT, and `ended`, the share of rollouts without a score.
        Raises InputError where none has one."""
        setup = replace(self.setup, evasions=False)  # no trial is judged by them
        rows, samples, ended = drive_all([setup], [method], self.seeds, None, self.processes)
        require_rows(rows, ended, None)
        if ended:
            tqdm.write(f"{len(ended)} rollouts ended without a score: {summary_of(ended)}", sys.stderr)
        found = summarise(rows, samples, realism_draws=0)
        metrics = {name: found[name]["mean"] for name in MEASURED} | {"ended": len(ended) / (len(rows) + len(ended))}
        return metrics | {f"{name}_{end}": found[name][end] for name in SOUGHT for end in ("low", "high")}
