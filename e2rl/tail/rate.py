"""How often an ego fails in scenes, in traffic as the prior has it: populations of
rollouts, a few scenes at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch

from e2rl.driving.batches import Work, split_tasks
from e2rl.driving.scored import Scored
from e2rl.driving.setup import Method, Setup, Task
from e2rl.run.cpu import onednn_products
from e2rl.run.processes import in_processes
from e2rl.run.terminal import Bar
from e2rl.tail.estimate import Estimate
from e2rl.tail.noise import ChosenNoise, NoiseLayout
from e2rl.tail.population import OneRollout, Population, one_by_one
from e2rl.tail.sampler import REACHED, Tally
from e2rl.tail.settings import RateSettings
from e2rl.traffic.attempt import attempt
from e2rl.traffic.nominal import NominalTraffic

TAIL = "tail"  # the method of these rollouts in tables and files


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
        repetitions = settings.populations
        total = len(scenes) * repetitions
        with Bar(total=total, desc="populations", unit="population") as bar:
            first = list(self._all(self._jobs(scenes, [0]), work, bar))
            reached = [part.scene for part in first if part.tally.end == REACHED]
            jobs = self._jobs(reached, range(1, repetitions))
            return first + list(self._all(jobs, work, bar))

    def _jobs(self, scenes: Sequence[int], repetitions: Sequence[int]) -> list[Job]:
        together = self.settings.together
        parts = [
            tuple(scenes[begin : begin + together])
            for begin in range(0, len(scenes), together)
        ]
        return [
            Job(f"{self.setup.ego_name}-{repetition}-{part[0]:06}", part, repetition)
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

    @onednn_products()
    def _drive(self, job: Job, folder: Path | None) -> list[tuple]:
        """The estimates of a job, of plain values."""
        scene = self.setup.scenes.batch(job.scenes)
        layout = NoiseLayout.of(
            self.traffic.prior,
            vehicles=scene["route_valid"].shape[1],
            horizon=scene["logged"].shape[1] - 1,
        )
        populations = [
            Population.begin(
                self.setup,
                self.settings,
                layout,
                scene=number,
                repetition=job.repetition,
                seed=self.seed,
            )
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
    ) -> list[OneRollout]:
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
