"""How often an ego fails in scenes, in traffic as the prior has it: populations of
rollouts, a few scenes at a time."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.driving.batches import Work, split_tasks
from e2rl.driving.setup import Method, Scored, Setup, Task
from e2rl.metrics.errored import errored_row, lost, raised
from e2rl.metrics.realism import NO_SAMPLES
from e2rl.metrics.score import score_rollouts
from e2rl.run.config import configured, setting
from e2rl.run.processes import in_processes
from e2rl.run.terminal import Bar
from e2rl.scenes.recording import VEHICLE
from e2rl.sim.rollouts import Rollouts
from e2rl.tail.level import FARTHEST, TARGETS, contacts, levels
from e2rl.tail.moves import Moves
from e2rl.tail.noise import ChosenNoise, NoiseLayout
from e2rl.tail.plain import Plain
from e2rl.tail.sampler import (
    EXTINCT,
    REACHED,
    Driven,
    Sampler,
    SamplerSettings,
    Tally,
)
from e2rl.tail.subset import Subset
from e2rl.traffic.attempt import attempt
from e2rl.traffic.nominal import NominalTraffic

TAIL = "tail"  # the method of these rollouts in tables and files
ALONE = "alone"  # no vehicle is driven by the prior, so nothing is left to chance
NEARBY = 20.0  # m from the ego at which a vehicle is moved alone half as often
SEED_STEP = 1_000_003  # between the seeds of two repetitions
METHODS: dict[str, type[Sampler]] = {"subset": Subset, "plain": Plain}
UNKNOWN = -10 * FARTHEST  # the level of a rollout in which the traffic raised


@configured("rate", "rate")
@dataclass(frozen=True)
class RateSettings:
    """What is estimated, and how often; conf/rate.yaml explains each."""

    method: str = setting(choices=METHODS)
    target: str = setting(choices=TARGETS)
    repetitions: int = setting(low=1)
    particles: int = setting(low=4)
    killed: float = setting(low=0.05, high=0.95)
    moves: int = setting(low=1)
    rollouts: int = setting(low=4)
    least: float = setting(low=0, high=1)
    together: int = setting(low=1)

    @property
    def sampler(self) -> SamplerSettings:
        """Those of one population."""
        names = [field.name for field in fields(SamplerSettings)]
        return SamplerSettings(**{name: getattr(self, name) for name in names})


class Estimate(NamedTuple):
    """What one population says of a scene.

    Args:
        scene: its position.
        repetition: of the population.
        tally: the probabilities.
        km: that the ego drives in a rollout, on average.
        raised: rollouts in which the planner raised, which count as failures.
        lost: rollouts in which the traffic raised, which are none.
        failures: the rollouts that reached the target; rows have a `weight`.
    """

    scene: int
    repetition: int
    tally: Tally
    km: float
    raised: int
    lost: int
    failures: Scored


class Job(NamedTuple):
    """Populations that are driven together: of some scenes, in one repetition."""

    name: str
    scenes: tuple[int, ...]
    repetition: int


@dataclass
class Rating:
    """The estimates of one ego.

    Args:
        setup: scenes, ego and simulator.
        traffic: whose tail is drawn.
        settings: what is estimated.
        seed: of all draws.
    """

    setup: Setup
    traffic: NominalTraffic
    settings: RateSettings
    seed: int = 0

    def estimates(self, work: Work) -> list[Estimate]:
        """Returns the estimates of all scenes: one population of each, then
        `repetitions` of those whose failures the first did not find out of reach.

        Args:
            work: processes, scenes, parts on disk, and the folder of rollouts.
        """
        scenes = list(work.scenes(self.setup))
        settings = self.settings
        total = len(scenes) * settings.repetitions
        with Bar(total=total, desc="populations", unit="population") as bar:
            first = list(self._all(self._jobs(scenes, [0]), work, bar))
            reached = [part.scene for part in first if part.tally.end == REACHED]
            jobs = self._jobs(reached, range(1, settings.repetitions))
            return first + list(self._all(jobs, work, bar))

    def _jobs(self, scenes: Sequence[int], repetitions: Sequence[int]) -> list[Job]:
        together = self.settings.together
        parts = [
            tuple(scenes[begin : begin + together])
            for begin in range(0, len(scenes), together)
        ]
        return [
            Job(f"rate-{repetition}-{part[0]:06}", part, repetition)
            for repetition in repetitions
            for part in parts
        ]

    def _all(self, jobs: Sequence[Job], work: Work, bar: Bar) -> Iterator[Estimate]:
        def result_of(job: Job) -> list[tuple]:
            identity = [
                self.setup.ego_name,
                asdict(self.settings),
                self.seed,
                list(job.scenes),
                job.repetition,
            ]
            drive = partial(self._drive, job, work.into)
            return work.parts.result(job.name, identity, drive)

        for results in in_processes(
            result_of,
            jobs,
            processes=work.processes,
            cost=lambda job: len(job.scenes),
            ended=lambda job: bar.update(len(job.scenes)),
        ):
            for scene, repetition, tally, km, raises, losses, failures in results:
                yield Estimate(
                    scene,
                    repetition,
                    Tally(**tally),
                    km=km,
                    raised=raises,
                    lost=losses,
                    failures=Scored(*failures),
                )

    def _drive(self, job: Job, folder: Path | None) -> list[tuple]:
        """The estimates of a job, of plain values."""
        scene = self.setup.scenes.batch(job.scenes)
        layout = NoiseLayout.of(
            self.traffic.prior,
            vehicles=scene["route_valid"].shape[1],
            horizon=scene["logged"].shape[1] - 1,
        )
        populations = [
            Population.begin(self, layout, number, job.repetition)
            for number in job.scenes
        ]
        traffic = ChosenNoise(
            self.traffic.prior, layout, knowledge=self.traffic.knowledge
        )
        while active := [part for part in populations if not part.sampler.ended]:
            asked = [part.sampler.ask() for part in active]
            traffic.normals = torch.cat(asked)
            scenes = [
                part.scene
                for part, normals in zip(active, asked, strict=True)
                for _ in normals
            ]
            driven = self._roll_out(traffic, scenes, job.repetition)
            begin = 0
            for part, normals in zip(active, asked, strict=True):
                part.tell(driven[begin : begin + len(normals)])
                begin += len(normals)
        return [part.result(folder) for part in populations]

    def _roll_out(
        self, traffic: ChosenNoise, scenes: Sequence[int], repetition: int
    ) -> list["OneRollout"]:
        """What becomes of rollouts with the traffic's normals, in their order."""
        method = Method(TAIL, traffic)
        tasks = [Task(scene, repetition, noise=row) for row, scene in enumerate(scenes)]
        results: dict[int, OneRollout] = {}
        for batch in split_tasks(tasks, self.setup.batch):
            parts, errored = attempt(partial(self.setup.roll_out, method), batch)
            for driven, rollouts in parts:
                judged = one_by_one(rollouts)
                for task, rollout in zip(driven, judged, strict=True):
                    assert task.noise is not None
                    results[task.noise] = rollout
            for task, reason in errored:
                assert task.noise is not None
                entry = (
                    self.setup.source(method)
                    | {"eta": 0.0, "scene_id": self.setup.scenes.scene_id[task.scene]}
                    | {"location": self.setup.scenes.location[task.scene]}
                    | {"seed": task.seed}
                    | reason
                )
                results[task.noise] = OneRollout.errored(entry)
        return [results[row] for row in range(len(tasks))]


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
        cls, rating: Rating, layout: NoiseLayout, scene: int, repetition: int
    ) -> "Population":
        """Returns the population of a scene before its first rollout."""
        number = rating.setup.scenes.number[scene]
        seed = (rating.seed * SEED_STEP + repetition) * SEED_STEP + number
        weight = vehicle_weight(rating.setup, scene)
        moves = Moves(
            weight, layout.replan_of(), torch.Generator().manual_seed(seed % 2**63)
        )
        sampler = METHODS[rating.settings.method](
            target=TARGETS[rating.settings.target],
            settings=rating.settings.sampler,
            moves=moves,
            shape=(layout.vehicles, layout.numbers),
        )
        return cls(scene, repetition, sampler, alone=not bool(weight.any()))

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
        if first and self.alone and self.sampler.tally.end in ("", EXTINCT):
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


def vehicle_weight(setup: Setup, scene: int) -> Tensor:
    """Returns how often each vehicle [V] of a scene is moved alone: more the nearer it
    begins to the ego; 0 for the ego and whom the prior does not drive."""
    batch = setup.scenes.batch([scene])
    vehicles = batch["route_valid"].shape[1]
    start = batch["start"][0, :vehicles]
    distance = (start[:, :2] - start[:1, :2]).norm(dim=-1)
    driven = batch["valid"] & ~batch["parked"] & (batch["agent_type"] == VEHICLE)
    driven = driven[0, :vehicles].clone()
    driven[0] = False
    return driven / (1 + distance / NEARBY)
