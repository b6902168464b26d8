"""The population of one scene: its sampler, and what becomes of the rollouts that it asks
for."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.driving.scored import Scored
from e2rl.driving.setup import Setup
from e2rl.metrics.errored import errored_row, lost, raised
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.score import score_rollouts
from e2rl.scenes.recording import VEHICLE
from e2rl.sim.rollouts import Rollouts
from e2rl.tail.level import FARTHEST, TARGETS, contacts, levels
from e2rl.tail.moves import Moves
from e2rl.tail.noise import NoiseLayout
from e2rl.tail.sampler import ALONE, EXTINCT, REACHED, Driven, Sampler
from e2rl.tail.settings import METHODS, RateSettings

NEARBY = 20.0  # m from the ego at which a vehicle is moved alone half as often
SEED_STEP = 1_000_003  # between the seeds of two repetitions
UNKNOWN = -10 * FARTHEST  # the level of a rollout in which the traffic raised


class OneRollout(NamedTuple):
    """A rollout as its level tells it.

    Args:
        level: how near it comes to a failure.
        km: that the ego drives; NaN where the planner or the traffic raised.
        row: its metrics where there is a contact, and what was raised.
        sample: of realism, where there is a contact.
        entry: of errored.json, where the planner or the traffic raised.
        rollouts: itself where there is a contact.
    """

    level: float
    km: float
    row: dict | None = None
    sample: dict[str, Tensor] = NO_SAMPLES
    entry: dict | None = None
    rollouts: Rollouts | None = None

    @classmethod
    def errored(cls, entry: dict) -> "OneRollout":
        """Returns the rollout of an entry of errored.json."""
        row = errored_row(entry)
        level = max(TARGETS.values()) if raised(row) else UNKNOWN
        return cls(level, math.nan, row, entry=entry)

    def scored(self, seed: int, weight: float, folder: Path | None) -> Scored:
        """Returns what it scored, under a seed of its own, and writes its file.

        Args:
            seed: in tables and file names.
            weight: part of the probability that it stands for.
            folder: of the files; None: none is written.
        """
        assert self.row is not None
        if self.rollouts is not None and folder is not None:
            self.rollouts.seed = torch.tensor([seed])
            self.rollouts.to_npz(folder)
        entries = [] if self.entry is None else [self.entry | {"seed": seed}]
        row = self.row | {"seed": seed, "weight": weight}
        return Scored([row], [self.sample], entries)


def one_by_one(rollouts: Rollouts) -> list[OneRollout]:
    """Returns each of some rollouts; only those with a contact are scored whole."""
    hit, km = contacts(rollouts)
    index = hit.nonzero()[:, 0].tolist()
    scored: dict[int, tuple] = {}
    if index:
        touching = rollouts[index]
        rows, samples = score_rollouts(touching)  # which sets `driver`
        scored = {
            number: (rows[place], samples[place], touching[[place]])
            for place, number in enumerate(index)
        }
    by_number = {number: row for number, (row, *_) in scored.items()}
    level = levels(rollouts, by_number).tolist()
    results = []
    for number in range(len(rollouts)):
        row, sample, whole = scored.get(number, (None, NO_SAMPLES, None))
        rollout = OneRollout(level[number], km[number], row, sample, rollouts=whole)
        results.append(rollout)
    return results


@dataclass
class Population:
    """The sampler of one scene, and what its rollouts showed."""

    scene: int
    repetition: int
    sampler: Sampler
    alone: bool
    km: float = 0.0
    raised: int = 0
    lost: int = 0

    @classmethod
    def begin(
        cls,
        setup: Setup,
        settings: RateSettings,
        layout: NoiseLayout,
        *,
        scene: int,
        repetition: int,
        seed: int,
    ) -> "Population":
        """Returns the population of a scene before its first rollout.

        Args:
            setup: scenes, ego and simulator.
            settings: what is estimated.
            layout: of a rollout's noise.
            scene: its position.
            repetition: number of the population.
            seed: of all scenes' draws.
        """
        number = setup.scenes.number[scene]
        draw = (seed * SEED_STEP + repetition) * SEED_STEP + number
        generator = torch.Generator().manual_seed(draw % 2**63)
        effect = vehicle_effect(setup, scene)
        sampler = METHODS[settings.method](
            target=TARGETS[settings.target],
            settings=settings.sampler,
            moves=Moves(effect, layout.replan_of(), generator),
            shape=(layout.vehicles, layout.numbers),
        )
        return cls(scene, repetition, sampler, alone=not bool(effect.any()))

    def tell(self, driven: Sequence[OneRollout]) -> None:
        """Take what became of the rollouts that were asked for last."""
        first = not self.sampler.tally.rollouts
        if first:
            km = [rollout.km for rollout in driven if not math.isnan(rollout.km)]
            self.km = sum(km) / max(len(km), 1)
        rows = [rollout.row or {} for rollout in driven]
        self.raised += sum(map(raised, rows))
        self.lost += sum(map(lost, rows))
        counted = [row.get("cfr_counted") == 1 or raised(row) for row in rows]
        self.sampler.tell(
            Driven(
                torch.tensor([part.level for part in driven], dtype=torch.float64),
                torch.tensor(counted),
                list(driven),
            )
        )
        fails = any(part.level >= self.sampler.target for part in driven)
        ended = self.sampler.tally.end not in ("", EXTINCT)
        if first and self.alone and not fails and not ended:
            self.sampler.tally.end = ALONE
            self.sampler.tally.bound = 0.0

    def result(self, folder: Path | None) -> tuple:
        """Returns the fields of Estimate, and writes the failures' files."""
        tally = self.sampler.tally
        failures = self.sampler.failures() if tally.end == REACHED else []
        begin = self.repetition * self.sampler.settings.rollouts
        scored = Scored()
        for index, failure in enumerate(failures):
            weight = tally.probability / len(failures)
            scored.add(failure.scored(begin + index, weight=weight, folder=folder))
        return (
            self.scene,
            self.repetition,
            asdict(tally),
            self.km,
            self.raised,
            self.lost,
            (scored.rows, scored.samples, scored.errored),
        )


def vehicle_effect(setup: Setup, scene: int) -> Tensor:
    """Returns a guess of how much each vehicle [V] of a scene changes the level: more the
    nearer it begins to the ego; 0 for the ego and whom the prior does not drive."""
    batch = setup.scenes.batch([scene])
    vehicles = batch["route_valid"].shape[1]
    start = batch["start"][0, :vehicles]
    distance = (start[:, :2] - start[:1, :2]).norm(dim=-1)
    driven = batch["valid"] & ~batch["parked"] & (batch["agent_type"] == VEHICLE)
    driven = driven[0, :vehicles].clone()
    driven[0] = False
    return driven / (1 + distance / NEARBY)
