"""What becomes of each scene over versions of a planner, of which each has a run.

A version fails in a scene where a rollout, or a try of a search, ends in a preventable
failure or the planner raises, as in the headline.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from e2rl.evaluation.comparison import OTHERS, Driven, check_shared
from e2rl.evaluation.rollout_files import RATES_FILE
from e2rl.metrics.errored import lost, raised
from e2rl.metrics.failure_modes import Row, is_failure
from e2rl.run.errors import InputError

KINDS = {  # of what happens in a scene, the worst first
    "E": "the planner raised",
    "P": "preventable failure",
    "C": "failure that counts, not preventable",
    "H": "contact that does not count, or with other than a vehicle",
    "·": "no contact",
}
FAILING = ("E", "P")
NEW = "new"  # fails in the newest version, in none before
MENDED = "mended"  # does not fail any more
FLICKERS = "flickers"  # has been mended, and failed again
LASTS = "lasts"  # fails ever since a version that was neither the first nor the newest
ALWAYS = "always"
NEVER = "never"
CHANGES = (NEW, MENDED, FLICKERS, LASTS, ALWAYS, NEVER)


class SceneResult(NamedTuple):
    """What one version does in a scene.

    Args:
        kind: of KINDS, the worst.
        events: number of rollouts that are of this kind.
        rollouts: number in the scene.
        row: a rollout of this kind, with a failure to watch where any has one.
    """

    kind: str
    events: int
    rollouts: int
    row: Row


class SceneHistory(NamedTuple):
    """What all versions do in a scene.

    Args:
        scene: its id.
        change: of CHANGES.
        version: position of the version with the last change; -1: none.
        results: of each version, None where it has not driven the scene.
    """

    scene: str
    change: str
    version: int
    results: list[SceneResult | None]

    @property
    def failing(self) -> bool:
        """Whether the newest version fails."""
        result = self.results[-1]
        return result is not None and result.kind in FAILING


def read_versions(runs: Sequence[Path], ego: str | None) -> list[Driven]:
    """Returns the rollouts of each run's ego, None: of its only one; raises InputError
    for a run that is named twice, one of `e2rl rate`, and where rollouts are no pairs
    (`check_shared`)."""
    if len({run.resolve() for run in runs}) < len(runs):
        raise InputError("a run is named twice; name each version once, oldest first")
    for run in runs:
        if (run / RATES_FILE).is_file():
            raise InputError(
                f"{run}: a run of e2rl rate, which draws its rollouts from the tail; "
                "compare two by e2rl gate RUN RULE --against RUN"
            )
    versions = [Driven.read(run, ego) for run in runs]
    for version in versions[1:]:
        check_shared(versions[0], version)
    return versions


def version_names(runs: Sequence[Path]) -> list[str]:
    """Returns the names of folders, with as many of those above as tell them apart."""
    parts = [run.resolve().parts for run in runs]
    for depth in range(1, max(map(len, parts))):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            break
    return names


def kind_of(row: Row) -> str:
    """Returns the kind, of KINDS, of a rollout."""
    if raised(row):
        return "E"
    if row["cfr_preventable"] == 1:
        return "P"
    if row["cfr_counted"] == 1:
        return "C"
    return "H" if any(row[column] == 1 for column in ("cfr", *OTHERS)) else "·"


def scene_results(rows: Sequence[Row]) -> dict[str, SceneResult]:
    """Returns the result of each scene from rollouts of one version in one traffic,
    without those that the traffic lost."""
    scenes: dict[str, list[Row]] = {}
    for row in rows:
        if not lost(row):
            scenes.setdefault(row["scene_id"], []).append(row)
    results = {}
    for scene, group in scenes.items():
        kinds = list(map(kind_of, group))
        kind = next(kind for kind in KINDS if kind in kinds)
        worst = [row for row in group if kind_of(row) == kind]
        watched = next(filter(is_failure, worst), worst[0])
        results[scene] = SceneResult(kind, len(worst), len(group), watched)
    return results


def change_of(failing: Sequence[bool | None]) -> tuple[str, int]:
    """Returns the change, of CHANGES, of a scene, and the position of the version with
    the last one, -1 for none; failing: each version, None where it has not driven."""
    driven = [
        (version, state) for version, state in enumerate(failing) if state is not None
    ]
    turns = [
        version
        for (_, before), (version, state) in pairwise(driven)
        if state is not before
    ]
    if not any(failing):
        return NEVER, -1
    if not turns:
        return ALWAYS, -1
    after_first = turns if driven[0][1] else turns[1:]  # the first failure
    if not after_first:
        return (NEW if turns[0] == len(failing) - 1 else LASTS), turns[0]
    return (MENDED if len(after_first) == 1 else FLICKERS), turns[-1]


def scene_histories(
    versions: Sequence[Mapping[str, SceneResult]],
) -> list[SceneHistory]:
    """Returns the history of each scene, in the order of CHANGES, then the latest change
    first; versions: `scene_results` of each."""
    histories = []
    for scene in sorted({scene for results in versions for scene in results}):
        results = [version.get(scene) for version in versions]
        failing = [result and result.kind in FAILING for result in results]
        change, version = change_of(failing)
        histories.append(SceneHistory(scene, change, version, results))
    histories.sort(key=attrgetter("version", "failing"), reverse=True)
    return sorted(histories, key=lambda history: CHANGES.index(history.change))
