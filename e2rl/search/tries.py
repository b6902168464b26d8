"""Tries, each one attack on one scene, reproducible from its seed and decisions;
families that they are drawn from."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from e2rl.run.errors import InputError
from e2rl.run.settings import check_choice
from e2rl.traffic.decisions import RULE, WHOM, Decisions

TRIES = 10_000  # of a scene that have seeds of their own
DRAWN = Decisions._fields
PRIMES = (
    2,
    3,
    5,
    7,
    11,
    13,
    17,
)  # of the square roots that stratify the draws of one decision each


class Try(NamedTuple):
    """One attack on one scene.

    scene: its position; number: of the try among those of the scene; family: that it is
    drawn from; seed: of its noise; decisions: `Decisions`.
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
        chance, nfe: of a failure in a try, and what a try costs, by which the portfolio
            begins.
    """

    name: str
    method: str
    ranges: Mapping[str, tuple[float, float] | float]
    changes: Mapping[str, Any] = field(default_factory=dict)
    chance: float = 0.1
    nfe: float = 160.0

    def draw(self, scene: int, number: int, seed: int, stratified: bool) -> Try:
        """The try `number` of a scene; reproducible from the seed of the scene's
        search.

        Stratified, the decisions of consecutive tries of a scene, of whatever families,
        follow the additive recurrence of square roots of primes, and so look elsewhere
        than those before.
        """
        generator = torch.Generator().manual_seed(
            seed if stratified else seed + 7919 * (number + 1)
        )
        u = torch.rand(len(DRAWN), generator=generator, dtype=torch.float64)
        if stratified:
            u = (u + number * torch.tensor(PRIMES, dtype=torch.float64).sqrt()) % 1
        return self.attempt(scene, number, seed=seed, draw=u)

    def attempt(self, scene: int, number: int, seed: int, draw: Tensor) -> Try:
        """The try `number` of a scene whose decisions are those of uniform numbers draw
        [len(DRAWN)] in [0, 1)."""
        found: dict[str, float] = {}
        for name, u in zip(DRAWN, draw.tolist(), strict=True):
            if name in self.ranges:
                span = self.ranges[name]
                found[name] = (
                    span[0] + u * (span[1] - span[0])
                    if isinstance(span, tuple)
                    else float(span)
                )
        return Try(
            scene,
            number,
            family=self.name,
            seed=seed * TRIES + number,
            decisions=tuple(RULE._replace(**found)),
        )


def family_of(name: str, given: Mapping[str, Any], where: str) -> Family:
    """A family of its configuration: `method`, `changes`, `chance`, `nfe`, and the
    ranges of decisions. Raises InputError where a key is no decision, or a value no
    number, pair of numbers, or kind of vehicle."""
    if not isinstance(given, Mapping) or not isinstance(
        given.get("changes", {}), Mapping
    ):
        raise InputError(
            f"{where}.{name}={given}: expected {{method: NAME, changes: {{}}, DECISION: [low, high]}}"
        )
    ranges: dict[str, tuple[float, float] | float] = {}
    for key, value in given.items():
        if key in ("method", "changes", "chance", "nfe"):
            continue
        check_choice(f"{where}.{name}: decision {key}", key, choices=DRAWN)
        if key == "whom":
            check_choice(f"{where}.{name}.whom", value, choices=WHOM)
            value = WHOM.index(value)
        numbers = value if isinstance(value, list | tuple) else [value]
        known = len(numbers) in (1, 2) and all(
            isinstance(number, int | float) for number in numbers
        )
        if not known or not 0 <= numbers[0] <= numbers[-1]:
            raise InputError(
                f"{where}.{name}.{key}={value}: expected a number from 0 on, or [low, high]"
            )
        low, high = float(numbers[0]), float(numbers[-1])
        ranges[key] = (low, high) if len(numbers) == 2 else low
    about: dict[str, Any] = {
        key: given[key] for key in ("chance", "nfe") if key in given
    }
    for key, value in about.items():
        most = {"chance": 1.0, "nfe": 1e9}[key]
        if not isinstance(value, int | float) or not 0 < value <= most:
            raise InputError(
                f"{where}.{name}.{key}={value}: expected a number above 0, at most {most:g}"
            )
    return Family(
        name,
        str(given.get("method", "e2")),
        ranges=ranges,
        changes=dict(given.get("changes", {})),
        **about,
    )
