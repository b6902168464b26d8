"""What would go wrong in an evaluation: of its configuration, its data, the machine."""

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from omegaconf import DictConfig

from e2rl.driving.setup import Setup
from e2rl.evaluation.build import build_egos, build_prior, build_rows, build_sim
from e2rl.evaluation.check import EvaluationSettings, evaluation_settings
from e2rl.evaluation.extent import Extent, extent_of
from e2rl.evaluation.finding import Finding
from e2rl.evaluation.planner_check import PlannerCheck, telling_scenes
from e2rl.run.config import load_choice
from e2rl.run.errors import InputError
from e2rl.run.fused import has_compiler, switch
from e2rl.run.machine import set_up
from e2rl.run.processes import cores
from e2rl.scenes.content import content
from e2rl.scenes.recording import DT
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_cache import Index, uncached
from e2rl.scenes.scene_list import read_list
from e2rl.scenes.source import Row, Source, load_scenes, source_of
from e2rl.traffic.fusing import EARNED, fused_functions

SAMPLE = 8  # scenes that are looked at
LOGS = 24  # recordings for these, at most
REASONS = 2  # of what is left out or mended
MOST = 50  # % of lanes, or routes, of which most have something
HOUR = 3600.0
LONG = 24.0  # hours of a run
Built = TypeVar("Built")


@dataclass(frozen=True)
class Sample:
    """The first scenes of the data.

    Args:
        source: of the data.
        rows: of the first recordings.
        scenes: that they make.
        total: about how many scenes the run has.
    """

    source: Source
    rows: Sequence[Row]
    scenes: SceneSet
    total: int

    @classmethod
    def of(cls, config: DictConfig) -> "Sample":
        """Returns the sample of a configuration; InputError where nothing makes a
        scene."""
        source = source_of(config.data)
        rows: list[Row] = []
        count = 0
        with closing(source.rows(SAMPLE)) as coming:
            for row in coming:
                rows.append(row)
                count += row.scene is not None
                if count == SAMPLE or len(rows) == LOGS:
                    break
        if not count:
            raise InputError(
                f"none of the first {len(rows)} recordings makes a scene: {rows[0].reason}"
            )
        windows = len(source.starts or (None,)) * len(source.versions)
        totals = [round(len(source.log_names()) * windows * count / len(rows))]
        if config.num_scenes is not None:
            totals.append(config.num_scenes)
        if config.scenes is not None:
            totals.append(len(read_list(config.scenes)))
        total = min(totals) if config.scene is None else 1
        return cls(source, rows, uncached(partial(indexed, rows)), total)

    def findings(self) -> Iterator[Finding]:
        """Yields what the recordings and their scenes hold, and lack."""
        scenes = self.scenes
        yield Finding(
            "scenes",
            True,
            f"{len(scenes)} of the first {len(self.rows)} recordings make one of "
            f"{DT * scenes.steps:g} s at {1 / DT:g} Hz; about {self.total} in the run",
        )
        for usual in (False, True):
            reasons = Counter(
                row.reason for row in self.rows if row.reason and row.usual is usual
            )
            fine = None if usual or self.source.skip_invalid else False
            mend = "" if fine is None else "or data.skip_invalid=true leaves it out"
            for reason, count in reasons.most_common(REASONS):
                yield Finding("left out", fine, f"{count} x {reason}", mend)
        yield from self._contents()
        repairs = sum((row.repairs for row in self.rows), Counter())
        for phrase, count in repairs.most_common(REASONS):
            yield Finding("mended", None, f"{count} {phrase}")

    def _contents(self) -> Iterator[Finding]:
        """Yields what the scenes hold: medians over them."""
        counts = [
            content(row.scene).counts for row in self.rows if row.scene is not None
        ]
        median = {
            key: float(np.median([row[key] for row in counts])) for key in counts[0]
        }
        moving = median["vehicles that move, beside the ego"]
        vehicles = (
            f"{median['vehicles']:.0f}, of which {moving:.0f} move beside the ego; "
            f"{median['vehicles near that none drives']:.0f} more near that nobody drives"
        )
        yield Finding("vehicles", bool(moving) or None, vehicles)
        lanes = bool(median["lanes"])
        yield Finding(
            "map",
            lanes,
            f"{median['lanes']:.0f} lanes, {median['km of lanes']:.1f} km; "
            f"{median['drivable polygons']:.0f} drivable polygons",
            "" if lanes else "let the reader give lanes (docs/guide/data.md)",
        )
        for about, key, lack in (
            ("links", "% of lanes with a successor", "vehicles' routes end early"),
            (
                "limits",
                "% of routes with a speed limit",
                "planners take their own speed",
            ),
        ):
            most = median[key] >= MOST
            yield Finding(
                about, most or None, f"{median[key]:.0f}{key}", "" if most else lack
            )
        yield Finding("lights", True, f"{median['traffic lights']:.0f} traffic lights")

    def prior(self, origin: Mapping[str, Any]) -> Finding:
        """Returns whether a prior of this origin knows such traffic."""
        trained = str(origin.get("data", "other data"))
        dataset = self.scenes.dataset
        drives = f"{dataset}/{self.source.split_name}"
        text = f"trained on {trained}, drives in {drives}"
        if trained == drives:
            return Finding("prior", None, text, "it has learned these very scenes")
        if trained.partition("/")[0] == dataset:
            return Finding("prior", True, text)
        mend = "python train.py stage=prior trains one on logs of this kind"
        return Finding("prior", None, text, mend)


def indexed(rows: Sequence[Row], index: Index) -> Iterator[Mapping[str, np.ndarray]]:
    """Yields the scenes of rows when they are in the index."""
    for row in rows:
        if row.scene is not None:
            index.dataset = row.dataset
            index.add(row.scene_id, row.location, row.scene)
            yield row.scene


class Preparation:
    """The objects of a configuration, as far as they can be built.

    refused: why others cannot be; all, not the first.
    """

    def __init__(self, config: DictConfig, name: str) -> None:
        """name: of the ego of the group `ego`."""
        self.refused: list[Finding] = []
        self.config = config
        self.name = name
        self._attempt("options", partial(set_up, config))
        self.device = "cpu" if self.refused else config.device
        self.settings = self._attempt("options", partial(evaluation_settings, config))
        self.sim = self._attempt("sim", partial(build_sim, config))
        self.egos = self._attempt("ego", partial(build_egos, config, name))
        self.sample = self._attempt("data", partial(Sample.of, config))
        if self.settings:
            rows = partial(build_rows, config, self.settings)
            self.rows = self._attempt("methods", rows)
        else:
            self.rows = None
            self._attempt("prior", partial(build_prior, config))
        self.uncompiled = sum(not part.file.exists() for part in fused_functions())
        compiled = not self.uncompiled and config.compile is not False
        switch(compiled and config.device == "cpu")

    def _attempt(self, about: str, build: Callable[[], Built]) -> Built | None:
        try:
            return build()
        except InputError as error:
            self.refused.append(Finding(about, False, str(error)))
            return None

    def planners(self) -> Iterator[tuple[str, Iterator[Finding]]]:
        """Yields the name of each ego, and what is right and wrong with it."""
        if not (self.egos and self.sim):
            return
        if self.sample:
            scenes = self.sample.scenes
            where = ""
        else:  # so that all is looked at
            scenes = load_scenes(load_choice("data", "bundled"), SAMPLE)
            where = " in bundled scenes"
        for name in self.egos.egos:
            planner = PlannerCheck(
                partial(self._ego, name),
                telling_scenes(scenes),
                sim=self.sim,
                device=self.device,
            )
            yield f"{name}{where}", planner.findings()

    def _ego(self, name: str) -> Any:
        """A new instance of an ego."""
        return build_egos(self.config, self.name).egos[name]

    def data(self) -> Iterator[Finding]:
        """Yields what is right and wrong with the data, for the prior, too."""
        if self.sample:
            yield from self.sample.findings()
            if self.rows:
                yield self.sample.prior(self.rows[1])

    def extent(self) -> Extent | None:
        """Returns what the run takes; None where that is not known."""
        if not (self.settings and self.sim and self.egos and self.sample and self.rows):
            return None
        ego_name, ego = next(iter(self.egos.egos.items()))
        setup = Setup(
            self.sample.scenes,
            ego,
            ego_name=ego_name,
            sim=self.sim,
            batch=self.config.batch,
            device=self.config.device,
        )
        _, _, methods, searches = self.rows
        return extent_of(
            setup,
            [*methods, *searches],
            self.settings,
            pairs=len(self.egos.egos) * self.sample.total * len(self.settings.seeds),
        )

    def machine(self) -> Iterator[Finding]:
        """Yields whether the machine has what the run needs."""
        if not self.refused:
            yield Finding("libraries", True, "all that this configuration needs")
        if self.config.compile is False or self.config.device != "cpu":
            yield Finding("compiled", None, "functions are not: compile, device")
        elif self.uncompiled:
            mend = "install a C++ compiler (g++) to run in half the time"
            if has_compiler():
                mend = "compile=true does so once, for half the time"
                if self.config.compile == "auto":
                    mend += f"; a run of {EARNED:,} rollouts does so by itself"
            yield Finding(
                "compiled", None, f"{self.uncompiled} functions are not yet", mend
            )
        else:
            yield Finding("compiled", True, "all functions are")
        if self.settings:
            count = self.settings.processes
            text = f"{count} of batches of {self.config.batch}, on {cores()} cores"
            few = count <= cores()
            yield Finding("processes", few or None, text, "" if few else "take fewer")


def run_findings(
    extent: Extent, settings: EvaluationSettings, folder: Path
) -> Iterator[Finding]:
    """Yields how long a run takes, and whether its files find room."""
    hours = extent.rollouts * extent.seconds / settings.processes / HOUR
    duration = f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min"
    short = hours <= LONG
    yield Finding(
        "duration",
        short or None,
        f"about {duration} on {settings.processes} processes: {extent.rollouts:.0f} "
        f"rollouts of {extent.seconds:.2f} s",
        ""
        if short
        else "fewer scenes, seeds or tries, or a cluster (docs/guide/cluster.md)",
    )
    needed = extent.rollouts * extent.size * settings.save_rollouts / 1e9
    free = shutil.disk_usage(folder).free / 1e9
    room = needed < free
    mend = (
        "" if room else "save_rollouts=false, or hydra.run.dir=FOLDER of another disk"
    )
    text = f"about {needed:.2f} GB of {free:.0f} GB that are free"
    yield Finding("disk", room, text, mend)
