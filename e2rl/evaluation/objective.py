"""What a planner's tuning minimises, and the trials that it refuses."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from e2rl.errors import InputError

NEEDED = ("collision", "comfort", "progress")


@dataclass(frozen=True)
class Objective:
    """comfort, progress: weights of the mean |acceleration| in m/s^2 and of the lost share of progress against the
    collision rate; progress_floor: share of the reference's progress below which a trial is refused, as standing still
    is the trivial optimum of safety; comfort_ceiling: multiple of the reference's |acceleration| above which it is."""

    comfort: float = 0.1
    progress: float = 0.1
    progress_floor: float = 0.9
    comfort_ceiling: float = math.inf

    def judge(self, metrics: Mapping[str, float], reference: Mapping[str, float]) -> tuple[float, float]:
        """(objective, excess) of metrics "collision" (rate), "comfort" (mean |acceleration|, m/s^2) and "progress" (m).

        reference: metrics of the present parameters. excess: the share by which a guard is missed; 0 for an admissible
        trial, inf for a metric that is NaN. A trial in which more rollouts ended for an error ("ended") than of the
        reference is not admissible. Raises InputError where a metric is missing.
        """
        ended = metrics.get("ended", 0.0) - reference.get("ended", 0.0)  # share or number, of both the same
        missing = [name for name in NEEDED if name not in metrics]
        if missing:
            raise InputError(f"planner tuning: evaluate() returned no {', '.join(missing)}")
        kept = metrics["progress"] / max(reference["progress"], 1e-6)
        rougher = metrics["comfort"] / max(reference["comfort"], 1e-6)
        lost = self.progress * max(0.0, 1 - kept)
        value = metrics["collision"] + self.comfort * metrics["comfort"] + lost
        excess = max(0.0, self.progress_floor - kept) + max(0.0, rougher - self.comfort_ceiling) + max(0.0, ended)
        return value, math.inf if math.isnan(value) else excess

    def text(self, metrics: Mapping[str, float]) -> str:
        """The metrics of a trial in a few words."""
        shares = ", ".join(
            f"{name.split()[1]} {100 * value:.1f}%" for name, value in metrics.items() if name.startswith("collision ")
        )
        lost = f"; {100 * metrics['ended']:.1f}% ended for an error" if metrics.get("ended") else ""
        return f"collisions {shares}; {metrics['comfort']:.2f} m/s^2, {metrics['progress']:.1f} m{lost}"
