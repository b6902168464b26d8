"""What a trial of a tuning is: new rollouts with its parameters, and the objective of
their metrics.

A replay of stored attacks would not do: it does not react to the planner under trial.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch

from e2rl.driving.batches import Batch, Work, drive_all, score_all
from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.rollout_files import require_rows
from e2rl.evaluation.tuning import Parameters
from e2rl.metrics.errored import lost, raised
from e2rl.metrics.statistics import summarise
from e2rl.planners.ego import Ego
from e2rl.run.config import configured, setting
from e2rl.traffic.attempt import count_reasons
from e2rl.traffic.traffic import Traffic

SOUGHT = ("cfr_preventable", "cfr_clean", "cfr_counted", "cfr")
MEASURED = (*SOUGHT, "aor_step", "cfr_bg", "real", "real_adv", "nfe")
ERRORED = 0.01  # fraction of rollouts that an attack may lose
# after a metric's name: its value in the traffic that the budget is held against
NOMINAL = "nominal"
DRIVING = ("collision", "comfort", "progress")
# columns of which one is a collision
COLLISIONS = ("cfr", "cfr_vru", "cfr_object", "ego_off_road")


@configured("tune", "tuning.planner")
@dataclass(frozen=True)
class PlannerObjective:
    """Minimised are collisions, and by their weights mean |acceleration| in m/s^2 and
    the lost fraction of progress.

    Args:
        comfort: weight.
        progress: weight.
        progress_floor: fraction of the present progress below which a trial is refused,
            as standing still is the trivial optimum of safety.
        comfort_ceiling: multiple of the present |acceleration| above which it is.
    """

    shown: ClassVar[tuple[str, ...]] = (*DRIVING, "errored")

    comfort: float = setting(low=0)
    progress: float = setting(low=0)
    progress_floor: float = setting(low=0)
    comfort_ceiling: float = setting(low=0)

    def judge(
        self,
        metrics: Mapping[str, float],
        reference: Mapping[str, float],
    ) -> tuple[float, float]:
        """See `Objective`. A trial in which the planner raised more often than in the
        reference is refused."""
        progress = metrics["progress"] / max(reference["progress"], 1e-6)
        roughness = metrics["comfort"] / max(reference["comfort"], 1e-6)
        loss = self.progress * max(0.0, 1 - progress)
        value = metrics["collision"] + self.comfort * metrics["comfort"] + loss
        excess = max(0.0, self.progress_floor - progress)
        excess += max(0.0, roughness - self.comfort_ceiling)
        excess += max(0.0, metrics.get("errored", 0.0) - reference.get("errored", 0.0))
        return value, math.inf if math.isnan(value) else excess


@configured("tune", "tuning.attack")
@dataclass(frozen=True)
class AttackObjective:
    """Maximised is the fraction of failures `seek`, within limits.

    A method that has no adversary in any rollout has no `real_adv`, and keeps every
    limit of it.

    Args:
        seek: one of SOUGHT.
        off_road: the most `aor_step` above nominal traffic.
        realism: the least `real_adv`; None: any.
    """

    shown: ClassVar[tuple[str, ...]] = (
        *SOUGHT,
        "aor_step",
        f"aor_step {NOMINAL}",
        "real_adv",
        "errored",
    )

    seek: str = setting(choices=SOUGHT)
    off_road: float = setting(low=0, high=1)
    realism: float | None = setting(low=0, high=1, optional=True)

    def judge(
        self,
        metrics: Mapping[str, float],
        reference: Mapping[str, float],
    ) -> tuple[float, float]:
        """See `Objective`; each trial has its nominal metrics. One whose traffic loses
        more than ERRORED of its rollouts beyond nominal traffic's is refused: it would
        be compared on other scenes."""
        off_road = metrics["aor_step"] - metrics[f"aor_step {NOMINAL}"]
        errored = metrics.get("errored", 0.0) - metrics.get(f"errored {NOMINAL}", 0.0)
        excess = max(0.0, off_road - self.off_road) + max(0.0, errored - ERRORED)
        if self.realism is not None and not math.isnan(metrics["real_adv"]):
            excess += max(0.0, self.realism - metrics["real_adv"])
        value = -metrics[self.seek]
        return value, math.inf if math.isnan(value + off_road) else excess


@dataclass
class PlannerTrials:
    """The metrics of a planner in all scenes, seeds and methods.

    Args:
        setup: scenes and simulator.
        methods: of the traffic.
        seeds: of the noise.
        make: the planner of some parameters.
        processes: that rollouts are spread over.
        failures: tries of a search that hit the planner, which are driven again.
    """

    setup: Setup
    methods: Sequence[Method]
    seeds: Sequence[int]
    make: Callable[[Parameters], Ego]
    processes: int = 1
    failures: Sequence[Batch] = ()

    def __call__(self, parameters: Parameters) -> dict[str, float]:
        """Returns the means of DRIVING, also of every method alone as `NAME
        METHOD@ETA`, and `errored`.

        collision: fraction of rollouts in which the ego touches something or leaves the
        road; comfort: mean |acceleration| [m/s^2]; progress [m]; errored: fraction in
        which the planner raised, of those that the traffic did not lose; `errored:
        REASON`: fraction of all that errored for each reason.
        """
        setup = replace(self.setup, ego=self.make(parameters), evasions=False)
        work = Work(processes=self.processes)
        driven = drive_all([setup], self.methods, seeds=self.seeds, work=work)
        jobs = [
            (f"{number}", batch._replace(setup=setup))
            for number, batch in enumerate(self.failures)
        ]
        for scored in score_all(jobs, work, cost=lambda job: len(job[1].tasks)):
            driven.add(scored)
        ended = [row for row in driven.rows if row["errored"] != 1]
        metrics = driving(ended)
        for method in (*self.methods, *(batch.method for batch in self.failures)):
            key = (method.name, method.eta)
            rows = [row for row in ended if (row["method"], row["eta"]) == key]
            for name, value in driving(rows).items():
                metrics[f"{name} {method.name}@{method.eta:g}"] = value
        for reason, number in count_reasons(driven.errored).items():
            metrics[f"errored: {reason}"] = number / len(driven.rows)
        crashed = sum(map(raised, driven.rows))
        metrics["errored"] = crashed / max(1, len(ended) + crashed)
        return metrics


def driving(rows: Sequence[Mapping]) -> dict[str, float]:
    """Returns the means of DRIVING over the rollouts that know them."""
    values = []
    for row in rows:
        collision = any(row.get(name) == 1 for name in COLLISIONS)
        values.append([float(collision), row["macc"], row["progress"]])
    means = torch.tensor(values, dtype=torch.float64).view(-1, len(DRIVING)).nanmean(0)
    return dict(zip(DRIVING, means.tolist(), strict=True))


@dataclass
class AttackTrials:
    """The metrics of an adversary in all scenes and seeds, and of nominal traffic.

    Args:
        setup: scenes, simulator and ego.
        nominal: traffic.
        eta: intensity of the adversary.
        seeds: of the noise.
        make: the adversary of some parameters.
        processes: that rollouts are spread over.
    """

    setup: Setup
    nominal: Method
    eta: float
    seeds: Sequence[int]
    make: Callable[[Parameters], Traffic]
    processes: int = 1

    def __call__(self, parameters: Parameters) -> dict[str, float]:
        """Returns the means of MEASURED, NAME_low and NAME_high of the 95% intervals of
        SOUGHT, and `errored`, the fraction that the traffic lost; and all of them as
        `NAME nominal` in nominal traffic. A rollout in which the planner raised is a
        failure of the planner."""
        method = Method("trial", self.make(parameters), eta=self.eta)
        return self.measure(method) | self.reference

    @cached_property
    def reference(self) -> dict[str, float]:
        """The metrics of nominal traffic."""
        measured = self.measure(self.nominal)
        return {f"{name} {NOMINAL}": measured[name] for name in (*MEASURED, "errored")}

    def measure(self, method: Method) -> dict[str, float]:
        """Returns the metrics of a method; InputError where all rollouts errored."""
        setup = replace(self.setup, evasions=False)  # no trial is judged by them
        work = Work(processes=self.processes)
        scored = drive_all([setup], [method], seeds=self.seeds, work=work)
        rows = scored.rows
        require_rows([row for row in rows if row["errored"] != 1], scored.errored)
        counted = [index for index, row in enumerate(rows) if not lost(row)]
        summary = summarise(*scored.where(counted), realism_draws=0)
        metrics = {name: summary[name]["mean"] for name in MEASURED}
        metrics["errored"] = 1 - len(counted) / len(rows)
        for name in SOUGHT:
            for end in ("low", "high"):
                metrics[f"{name}_{end}"] = summary[name][end]
        return metrics
