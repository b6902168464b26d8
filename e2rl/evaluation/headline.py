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
        tries: of a search of a scene in the mean.
        nfe: of a search of a scene in the mean, without tries that errored.
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
    scenes = set()
    preventable = set()
    crashed = set()
    cells = set()
    seeds = set()
    tries = 0
    nfe = 0.0
    for row in rows:
        if lost(row):
            continue
        scene = row["scene_id"]
        scenes.add(scene)
        seeds.add(row["seed"] // TRIES)
        tries += 1
        cost = row.get("nfe", 0.0)
        nfe += cost if cost == cost else 0.0
        if raised(row):
            crashed.add(scene)
        elif row.get("cfr_preventable") == 1:
            preventable.add(scene)
            cells.add(cell_of(row))
    searches = max(len(scenes) * len(seeds), 1)
    return Headline(
        scenes=len(scenes),
        preventable=len(preventable),
        raised=len(crashed),
        failed=len(preventable | crashed),
        ways=len(cells - {None}),
        searches=len(seeds) if searched else 0,
        tries=tries / searches if searched else 0.0,
        nfe=nfe / searches if searched else 0.0,
    )
