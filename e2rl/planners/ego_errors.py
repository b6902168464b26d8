"""What is raised where egos have no plan or action for scenes of their batch."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from torch import Tensor

from e2rl.run.errors import InputError

BY_EGO = "raised by the ego"  # note on what its code raises


class RowsError(Exception):
    """Rollouts of a batch end; rows: why, by row of the batch, empty where it is not
    known which.

    The others of the batch are driven anew without them.
    """

    def __init__(self, message: str, rows: Mapping[int, str] | None = None) -> None:
        super().__init__(message)
        self.rows = dict(rows or {})


@contextmanager
def renumbered(rows: Tensor) -> Iterator[None]:
    """Lets a RowsError of rows [G] of a batch name them by their numbers in that batch."""
    try:
        yield
    except RowsError as error:
        numbers = dict(enumerate(rows.tolist()))
        error.rows = {
            numbers[row]: why for row, why in error.rows.items() if row in numbers
        }
        raise


class PlannerError(RowsError):
    """A planner has no plan for scenes of its batch."""


class TrafficNotFinite(RowsError):
    """An ego was asked about vehicles whose states are NaN or infinite."""


class Undrivable(PlannerError):
    """A planner in this process asked for what no vehicle can drive."""


class PlannerExited(PlannerError):
    """A planner called sys.exit."""


class WrongPlan(PlannerError, InputError):
    """A planner returned something else than a tensor of the right shape; begins: at
    the start of its rollouts.

    Bad input where the run begins with it, else the end of these rollouts.
    """

    def __init__(self, message: str, begins: bool = False) -> None:
        super().__init__(message)
        self.begins = begins


class NotFinite(ArithmeticError):
    """An ego planned or acted NaN or infinite."""
