"""tries.csv: a line for each try of a search, from which tries are driven again."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from e2rl.driving.batches import Batch
from e2rl.driving.setup import Setup
from e2rl.run.errors import InputError
from e2rl.run.files import CsvReader, csv_text, write_atomically
from e2rl.run.run import check_run
from e2rl.search.search import Search
from e2rl.search.spending import SearchMethod, Spending
from e2rl.search.tries import TRIES, Try

COLUMNS = (
    "scene_id",
    "location",
    "seed",
    "method",
    "ego_policy",
    "family",
    "margin",
    "cell",
    "clean",
    "raised",
    "tries",
    "nfe",
    "seconds",
)


def write_tries(path: Path, tries: Sequence[Mapping]) -> None:
    """Write the tries of a run, a line each."""
    lines = [[line[name] for name in COLUMNS] for line in tries]
    write_atomically(path, csv_text([COLUMNS, *lines]))


def failures_of(
    file: Path,
    ego_name: str,
    *,
    method: SearchMethod,
    setup: Setup,
) -> list[Batch]:
    """Returns the tries of a tries.csv that hit an ego, to be driven again.

    Args:
        file: of the search.
        ego_name: of the ego, in the file.
        method: with the families that the tries are of.
        setup: to drive them in.

    Raises:
        InputError: for a file that is none, and for tries of other scenes, egos,
            families or searches, or of a run of another format.
    """
    check_run(file.parent)
    try:
        with file.open(newline="", encoding="utf-8") as lines:
            rows = [
                (row["scene_id"], int(row["seed"]), row["family"])
                for row in CsvReader(lines)
                if (row["method"], row["ego_policy"]) == (method.name, ego_name)
                and float(row["margin"]) >= 0
            ]
    except (OSError, ValueError, TypeError, KeyError, csv.Error) as error:
        raise InputError(
            f"{file}: no table of a search's tries ({error!r}); name the folder of a "
            "search"
        ) from None
    if not rows:
        raise InputError(
            f"{file}: no try of {method.name} hits {ego_name}; name a search against it"
        )
    families = {family.name: family for family in method.families}
    if unknown := {family for _, _, family in rows} - set(families):
        raise InputError(
            f"{file}: family {min(unknown)} is none of search.families; set these as in "
            "its run"
        )
    scenes = range(len(setup.scenes))
    searches: dict[int, Search] = {}
    tries: dict[int, list[Try]] = {}
    for scene_id, row_seed, family in rows:
        seed, number = divmod(row_seed, TRIES)
        if seed not in searches:
            searches[seed] = method.begin(setup, seed, scenes)
        search = searches[seed]
        if type(search) is not Search:
            raise InputError(
                f"{file}: a try of {type(search).__name__} depends on those before it; "
                "make the whole search again"
            )
        scene = setup.scenes.index(scene_id)
        drawn = families[family].draw(scene, number, seed=search.seed_of(scene))
        tries.setdefault(seed, []).append(drawn)
    batches: list[Batch] = []
    for seed, drawn_tries in tries.items():
        spending = Spending(
            setup,
            method,
            seed=seed,
            scenes=scenes,
            budget=0.0,
            unit="tries",
        )
        batches += map(spending.batch, spending.portions(drawn_tries))
    return batches
