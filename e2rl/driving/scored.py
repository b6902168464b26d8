"""What rollouts scored: rows of tables, which need none of what drove them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor


@dataclass
class Scored:
    """What rollouts scored.

    Args:
        rows: of rollouts.csv.
        samples: of realism, one for each row.
        errored: entries of errored.json.
    """

    rows: list[dict] = field(default_factory=list)
    samples: list[dict[str, Tensor]] = field(default_factory=list)
    errored: list[dict] = field(default_factory=list)

    def add(self, other: "Scored") -> None:
        """Add what others scored."""
        self.rows += other.rows
        self.samples += other.samples
        self.errored += other.errored

    def where(self, chosen: Sequence[int]) -> tuple[list[dict], list[dict]]:
        """Returns the rows and samples at some positions."""
        rows = [self.rows[index] for index in chosen]
        samples = [self.samples[index] for index in chosen]
        return rows, samples
