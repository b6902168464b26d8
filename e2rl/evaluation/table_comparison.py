"""Whether two tables hold the same numbers: the rows of two metrics.json."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from e2rl.run.errors import InputError

IDENTITY = ("stage", "dataset", "split", "method", "ego", "eta", "training")  # of a row, as far as it has them
COUNTS = ("n_scenes", "n_seeds", "n_rollouts", "ended")
CLOSE = 1e-6  # relative difference: rounding of another machine
TIMES = ("seconds_per_rollout",)  # metrics of wall time, which are never the same
SHOWN = 10  # differences in a text


@dataclass(frozen=True)
class Comparison:
    """Numbers that are equal, that differ by CLOSE at most, and [name, then, now] of those that differ more."""

    equal: int
    close: int
    different: list[tuple[str, Any, Any]]

    def text(self) -> str:
        """What came of it, in a line for each of the first SHOWN differences."""
        total = self.equal + self.close + len(self.different)
        if self.equal == total:
            return f"all {total:,} numbers of its tables are equal"
        said = f"{self.equal:,} of {total:,} numbers of its tables are equal"
        if self.close:
            said += f", {self.close:,} but for a millionth of them (another machine's rounding)"
        if not self.different:
            return said
        lines = [f"  {name}: {_shown(then)} then, {_shown(now)} now" for name, then, now in self.different[:SHOWN]]
        more = len(self.different) - len(lines)
        return "\n".join([f"{said}; {len(self.different):,} differ:", *lines, *([f"  and {more:,} more"] * (more > 0))])


def compare_tables(then: Sequence[Mapping], now: Sequence[Mapping]) -> Comparison:
    """The numbers of the rows of two metrics.json: counts, metrics and paired differences, wall times apart.

    Raises InputError for rows that are none of metrics.json.
    """
    try:
        before, after = (dict(number for row in rows for number in _numbers(row)) for rows in (then, now))
    except (TypeError, AttributeError, LookupError) as error:
        raise InputError(f"metrics.json: damaged ({error}); give the folder of a run of evaluate.py") from error
    equal = close = 0
    different = []
    for name in dict.fromkeys([*before, *after]):
        old, new = before.get(name, "missing"), after.get(name, "missing")
        if old == new or (_is_nan(old) and _is_nan(new)):
            equal += 1
        elif _is_number(old) and _is_number(new) and math.isclose(old, new, rel_tol=CLOSE, abs_tol=1e-12):
            close += 1
        else:
            different.append((name, old, new))
    return Comparison(equal, close, different)


def _numbers(row: Mapping) -> Iterator[tuple[str, Any]]:
    """(name, value) of every number of a row."""
    named = " ".join(str(row[key]) for key in IDENTITY if key in row)
    parts = {key: row[key] for key in COUNTS if key in row} | {"metrics": row["metrics"], "paired": row["paired"]}
    for key, value in _leaves(parts):
        if not set(key.split(": ")) & set(TIMES):
            yield f"{named}: {key.removeprefix('metrics: ')}", value


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _leaves(part, f"{name}: {key}" if name else str(key))
    else:
        yield name, value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float)


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
