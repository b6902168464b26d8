"""The headline of a planner in one traffic: in how many scenes it fails preventably,
and in how many it raised.

It is counted from the rows of rollouts here and nowhere else; all that a reader is
shown takes it from here.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from e2rl.metrics.atlas import cell_of
from e2rl.metrics.errored import lost, raised
from e2rl.search.tries import TRIES


class Headline(NamedTuple):
    """What rollouts of one ego in one traffic come to.

    Args:
        scenes: driven in; those of which the traffic lost all rollouts do not count.
        preventable: scenes with a preventable failure.
        raised: scenes in which the planner raised.
        failed: scenes with one of the two.
        ways: different ways of failing preventably, cells of the atlas.
        searches: of a scene, by how many seeds; 0: it was not searched.
        tries, nfe: of a search of a scene in the mean; nfe does not count tries that
            errored.
    """

    scenes: int
    preventable: int
    raised: int
    failed: int
    ways: int
    searches: int
    tries: float
    nfe: float


def headline(rows: Sequence[Mapping[str, Any]], searched: bool) -> Headline:
    """Returns the headline of rows of rollouts of one ego, method and intensity;
    `searched`: they are tries."""
    driven = [row for row in rows if not lost(row)]
    scenes = {row["scene_id"] for row in driven}
    failures = [
        row for row in driven if row.get("cfr_preventable") == 1 and not raised(row)
    ]
    preventable = {row["scene_id"] for row in failures}
    crashed = {row["scene_id"] for row in driven if raised(row)}
    cells = {cell_of(row) for row in failures} - {None}
    seeds = {row["seed"] // TRIES for row in driven} if searched else set()
    searches = max(len(scenes) * len(seeds), 1)
    known = [
        row["nfe"]
        for row in driven
        if row.get("nfe") == row.get("nfe") and "nfe" in row
    ]
    return Headline(
        scenes=len(scenes),
        preventable=len(preventable),
        raised=len(crashed),
        failed=len(preventable | crashed),
        ways=len(cells),
        searches=len(seeds),
        tries=len(driven) / searches if searched else 0.0,
        nfe=sum(known) / searches if searched else 0.0,
    )
