"""What `e2rl compare` tells: sentences, the pairs as JSON and CSV, and a page that shows both replays in step."""

import html
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

from tqdm import tqdm

from e2rl.evaluation.comparison import CHANGES, PAIR, RATES, Driven, check_pairs, groups_of, pairs_of
from e2rl.evaluation.rollout_files import cell, nulls, write_json
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.failure_modes import Row, is_failure, mode_name
from e2rl.report.answer import FEW, traffic_name, wrapped
from e2rl.report.failure_tracks import CHANNELS, MAP_QUANTUM, encoded_map, failure_replay
from e2rl.report.html import ASSETS, COLUMNS
from e2rl.report.tables import Table, difference_cell
from e2rl.run.files import csv_text, write_atomically
from e2rl.run.run import read_provenance
from e2rl.sim.rollout_file import ROLLOUTS, Failure, rollout_name

PAGE = "compare.html"
MOST = 200  # pairs that the page shows moving
FOLDER = ASSETS.parent / "compare"
SCRIPTS = (
    "palette",
    "plot",
    "decode",
    "scene",
    "plans",
    "curves",
    "verdict",
    "modes",
    "tables",
    "player",
)  # of the report
FACTS = (*COLUMNS[COLUMNS.index("approach") :], "partner", "min_dtc", "progress")  # of a rollout


def compare(first: Driven, second: Driven, path: Path) -> list[str]:
    """Writes the page, and JSON and CSV files of its name beside it; returns the lines that tell what has changed.
    Raises InputError where the two are no pairs."""
    if first.run != second.run:
        check_pairs(first, second)
    names = first.ego, second.ego
    if first.ego == second.ego:
        names = f"{first.ego} of {first.run}", f"{second.ego} of {second.run}"
    pairs = pairs_of(first, second)
    pairs.sort(
        key=lambda pair: (CHANGES.index(pair["change"]), *(-worst(pair, name) for name in ("preventable", "counted")))
    )
    groups = groups_of(first, second, pairs)
    told = list(sentences(names, groups, pairs, first, second))
    rows = [pair | {side: facts(pair[side]) for side in "ab"} for pair in pairs]
    changed = [pair for pair in pairs if pair["change"] != "same"]
    about = {"names": names, "runs": [str(first.run), str(second.run)], "groups": groups, "pairs": rows}
    replays = replays_of((first.run, second.run), changed[:MOST])
    text = page(
        {**about, "pairs": rows[: len(changed)], "told": told, "tables": [vars(table_of(names, groups))], **replays}
    )
    write_atomically(path, text)
    write_json(path.with_suffix(".json"), about)
    columns = [*facts(pairs[0]["a"])] if pairs else []
    lines = [["change", "what", *PAIR, *(f"{name}_{side}" for side in "ab" for name in columns)]]
    for row in rows:
        values = [row[side][name] for side in "ab" for name in columns]
        lines.append([row["change"], " ".join(row["what"]), *(row[name] for name in PAIR), *map(cell, values)])
    write_atomically(path.with_suffix(".csv"), csv_text(lines))
    files = f"{path.with_suffix('.csv')} and .json"
    return [
        *(line for sentence in told for line in wrapped(sentence, "  ")),
        f"Watch both: {path}",
        f"All pairs: {files}",
    ]


def worst(pair: Mapping, name: str) -> bool:
    """Whether one of both failures has a verdict."""
    return any(pair[side][name] == 1 for side in "ab")


def facts(row: Row) -> dict[str, Any]:
    """What the page knows of a rollout: FACTS, in words what happens, `contact`: whether it is a failure, its file."""
    hit = is_failure(row)
    values = {name: round(row[name], 4) if isinstance(row[name], float) else row[name] for name in FACTS}
    return {"contact": hit, "named": mode_name([row]) if hit else "no contact", **values, "file": rollout_name(row)}


def sentences(
    names: Sequence[str], groups: Sequence[Mapping], pairs: Sequence[Mapping], first: Driven, second: Driven
) -> Iterator[str]:
    """What has changed in each traffic, and what to know about it."""
    for group in groups:
        ours = [pair for pair in pairs if all(pair[name] == group[name] for name in ("method", "eta"))]
        new, gone, moved, same = (group[name] for name in CHANGES)
        text = f"{names[1]} against {names[0]}, {traffic_name(group)}, {group['pairs']} {group['unit']}: "
        if first.searched:
            yield f"{text}a search finds preventable failures in {moved + same + new} scenes, before in {moved + same + gone}: new in {new}, gone in {gone}, in other ways in {moved}."
        else:
            prevented = [
                sum(pair["change"] == change and pair[side]["preventable"] == 1 for pair in ours)
                for change, side in (("new", "b"), ("gone", "a"))
            ]
            yield (
                f"{text}{new} failures are new ({prevented[0]} preventable), {gone} gone ({prevented[1]}), {moved} moved, "
                f"{same} the same."
            )
        values = group["differences"].items()
        yield f"Difference: {'; '.join(f'{rate} {difference_cell(METRICS[RATES[rate]], value)}' for rate, value in values)} (points; progress in m)."
    if all(value["low"] != value["low"] for group in groups for value in group["differences"].values()):
        yield FEW
    if lost := sum(group["unpaired"] for group in groups):
        yield f"{lost} {groups[0]['unit']} of one without the other's are left out."
    versions = [read_provenance(run)["versions"][-1]["e2rl"] for run in {first.run, second.run}]
    if len(set(versions)) > 1:
        yield "The runs are of two versions of e2rl: what traffic does, and verdicts, may have changed, too."


def table_of(names: Sequence[str], groups: Sequence[Mapping]) -> Table:
    """A row for each traffic: numbers of CHANGES, and paired differences of RATES with intervals."""
    rates = [rate for rate in RATES if any(rate in group["differences"] for group in groups)]
    rows = [
        [traffic_name(group), str(group["pairs"]), *(str(group[name]) for name in CHANGES)]
        + [difference_cell(METRICS[RATES[rate]], group["differences"].get(rate)) for rate in rates]
        for group in groups
    ]
    units = [f"{rate} [{'points' if METRICS[RATES[rate]].fraction else 'm'}]" for rate in rates]
    caption = f"{names[1]} minus {names[0]}, 95% intervals by place; a star: the interval leaves out 0."
    return Table(caption, ["traffic", groups[0]["unit"], *CHANGES, *units], rows, "Differences")


def replays_of(runs: Sequence[Path], pairs: Sequence[Mapping]) -> dict[str, Any]:
    """`maps` and `replays` of the data block, two for each pair; none where a run has no files of rollouts."""
    maps: dict[str, int] = {}
    replays = []
    there = all((run / ROLLOUTS).is_dir() for run in runs)
    for pair in tqdm(pairs if there else [], desc="replays", leave=False, disable=None):
        both = [Failure.read(run, pair[side]) for run, side in zip(runs, "ab", strict=True)]
        for one, other in (both, both[::-1]):
            number = maps.setdefault(json.dumps(encoded_map(one.rollout)), len(maps))
            replays.append(failure_replay(one, other) | {"map": number})
    return {"maps": list(map(json.loads, maps)), "replays": replays, "channels": CHANNELS, "map_quantum": MAP_QUANTUM}


def page(content: Mapping[str, Any]) -> str:
    """The page with its data block."""
    scripts = [*(ASSETS / f"{name}.js" for name in SCRIPTS), FOLDER / "compare.js"]
    return Template((FOLDER / PAGE).read_text()).substitute(
        title=html.escape(" against ".join(content["names"][::-1])),
        style=(ASSETS / "page.css").read_text(),
        script="\n".join(path.read_text() for path in scripts),
        data=json.dumps(nulls(content), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
    )
