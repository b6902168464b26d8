"""What became of a round's attacks, and the table of a curriculum's choices (curriculum.csv)."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.traffic.template import TEMPLATES

Choice = dict[str, int | float | str]  # a row of the table, by COLUMNS
COLUMNS = {"round": int, "eta": float, "template": str, "draws": int, "left_out": int, "episodes": int, "failures": int}
COLUMNS |= {"failure_rate": float, "value": float}


@dataclass(frozen=True)
class Outcomes:
    """The S attacks of a round: eta [S]; template [S] int64; left_out [S] bool: no driver survives it, so it did not
    enter D'; episodes [S] int64 that the learning policy drove in it; failures [S] int64: those among them that ended
    by contact or off the road."""

    eta: Tensor
    template: Tensor
    left_out: Tensor
    episodes: Tensor
    failures: Tensor

    @property
    def failure_rate(self) -> Tensor:
        """The share of failures in the episodes [S]; NaN without an episode."""
        return self.failures / self.episodes


def outcomes_of(eta: Tensor, template: Tensor, drawn: Tensor, row: Tensor, failed: Tensor) -> Outcomes:
    """Outcomes of attacks [S] of which drawn [K] int64 are the first K rows of the pool (several rows may be one's):
    from episodes [E] with their pool row and whether they failed. Episodes in other rows do not count."""
    count, known = len(eta), row < len(drawn)
    attack, failed = drawn[row[known]], failed[known]
    left_out = torch.ones(count, dtype=torch.bool).index_fill(0, drawn, False)
    episodes, failures = (torch.bincount(each, minlength=count) for each in (attack, attack[failed]))
    return Outcomes(eta, template, left_out, episodes, failures)


def tally(number: int, level: Tensor, outcomes: Outcomes, value: Mapping[tuple[float, str], float]) -> list[Choice]:
    """The table of round `number`: a row for each intensity and causal template that was drawn or has a value.

    level [S]: the intensity under which each attack is counted; value: what the curriculum expects to learn from each
    (eta, template), {} where it does not estimate this. Unknown numbers are NaN.
    """
    arms = [
        (round(eta, 4), TEMPLATES[code]) for eta, code in zip(level.tolist(), outcomes.template.tolist(), strict=True)
    ]
    value = {(round(eta, 4), name): number for (eta, name), number in value.items()}
    rows: list[Choice] = []
    for arm in sorted({*arms, *value}, key=lambda each: (TEMPLATES.index(each[1]), each[0])):
        of_arm = torch.tensor([each == arm for each in arms], dtype=torch.bool)
        draws, left_out = int(of_arm.sum()), int(outcomes.left_out[of_arm].sum())
        episodes, failures = (int(each[of_arm].sum()) for each in (outcomes.episodes, outcomes.failures))
        rate = failures / episodes if episodes else float("nan")
        numbers = (draws, left_out, episodes, failures, rate, value.get(arm, float("nan")))
        rows.append(dict(zip(COLUMNS, (number, *arm, *numbers), strict=True)))
    return rows
