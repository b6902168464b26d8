"""Tries, each one attack on one scene, reproducible from its seed and decisions;
families that they are drawn from."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from e2rl.run.config import check_choice
from e2rl.run.errors import InputError
from e2rl.traffic.decisions import RULE, WHOM, Decisions

SEARCH = "search"  # the method whose tries are drawn from families
TRIES_FILE = "tries.csv"  # of `e2rl.search.tries_file`
TRIES = 10_000  # of a scene that have seeds of their own
DRAWN = Decisions._fields
# of the square roots that stratify the draws of one decision each
PRIMES = (2, 3, 5, 7, 11, 13, 17)
ABOUT = {"chance": 1.0, "nfe": 1e9}  # numbers of a family, with their largest value
Range = tuple[float, float] | float


class Try(NamedTuple):
    """One attack on one scene.

    Args:
        scene: its position.
        number: of the try among those of the scene.
        family: that it is drawn from.
        seed: of its noise.
        decisions: `Decisions`.
    """

    scene: int
    number: int
    family: str
    seed: int
    decisions: tuple[float, ...]


@dataclass(frozen=True)
class Family:
    """Attacks of one kind: a traffic method, and a range for each decision that is not
    its rule's.

    Args:
        name: of the family.
        method: of traffic, by name.
        ranges: {decision: (low, high) or one number}; whom: index into WHOM.
        changes: of the method's settings.
        chance: of a failure in a try, by which the portfolio begins.
        nfe: that a try costs, by which the portfolio begins.
    """

    name: str
    method: str
    ranges: Mapping[str, Range]
    changes: Mapping[str, Any] = field(default_factory=dict)
    chance: float = 0.1
    nfe: float = 160.0

    def draw(self, scene: int, number: int, seed: int) -> Try:
        """Returns the try `number` of a scene; reproducible from the seed of the
        scene's search. The decisions of consecutive tries of a scene, of whatever
        families, follow the additive recurrence of square roots of primes, and so look
        elsewhere than those before."""
        generator = torch.Generator().manual_seed(seed)
        draw = torch.rand(len(DRAWN), generator=generator, dtype=torch.float64)
        steps = torch.tensor(PRIMES, dtype=torch.float64).sqrt()
        draw = (draw + number * steps) % 1
        return self.attempt(scene, number, seed=seed, draw=draw)

    def attempt(self, scene: int, number: int, *, seed: int, draw: Tensor) -> Try:
        """Returns the try `number` of a scene whose decisions are those of uniform
        numbers.

        Args:
            scene: its position.
            number: of the try in the scene.
            seed: of the scene's search.
            draw: [len(DRAWN)] in [0, 1).
        """
        decisions = {}
        for name, u in zip(DRAWN, draw.tolist(), strict=True):
            span = self.ranges.get(name)
            if isinstance(span, tuple):
                low, high = span
                decisions[name] = low + u * (high - low)
            elif span is not None:
                decisions[name] = float(span)
        return Try(
            scene,
            number,
            family=self.name,
            seed=seed * TRIES + number,
            decisions=tuple(RULE._replace(**decisions)),
        )


def family_of(name: str, settings: Mapping[str, Any], where: str) -> Family:
    """Returns the family of its configuration: `method`, `changes`, `chance`, `nfe`,
    and the ranges of decisions. Raises InputError where a key is no decision, or a
    value no number, pair of numbers, or kind of vehicle."""
    place = f"{where}.{name}"
    nested = isinstance(settings, Mapping)
    if not nested or not isinstance(settings.get("changes", {}), Mapping):
        raise InputError(
            f"{place}={settings}: expected {{method: NAME, changes: {{}}, DECISION: "
            "[low, high]}"
        )
    ranges = {}
    about: dict[str, Any] = {}
    for key, value in settings.items():
        if key in ABOUT:
            if not isinstance(value, int | float) or not 0 < value <= ABOUT[key]:
                raise InputError(
                    f"{place}.{key}={value}: expected a number above 0, at most "
                    f"{ABOUT[key]:g}"
                )
            about[key] = value
        elif key not in ("method", "changes"):
            ranges[key] = range_of(key, value, place)
    return Family(
        name,
        str(settings.get("method", "e2")),
        ranges=ranges,
        changes=dict(settings.get("changes", {})),
        **about,
    )


def range_of(key: str, value: Any, place: str) -> Range:
    """Returns the range of a decision; raises InputError as `family_of` does."""
    check_choice(f"{place}: decision {key}", key, choices=DRAWN)
    if key == "whom":
        check_choice(f"{place}.whom", value, choices=WHOM)
        return float(WHOM.index(value))
    numbers = list(value) if isinstance(value, list | tuple) else [value]
    numeric = all(isinstance(number, int | float) for number in numbers)
    if len(numbers) not in (1, 2) or not numeric or not 0 <= numbers[0] <= numbers[-1]:
        raise InputError(
            f"{place}.{key}={value}: expected a number from 0 on, or [low, high]"
        )
    low = float(numbers[0])
    return (low, float(numbers[1])) if len(numbers) == 2 else low
