"""The headline and the errored rollouts in words, the same on the terminal, on the
pages, in gate and comparison."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

from e2rl.evaluation.headline import Headline
from e2rl.evaluation.rollout_files import ERRORED_FILE, TABLE
from e2rl.metrics.errored import lost, raised

NAMED = 12  # scenes of a message that a summary names
MESSAGES = 3  # that a summary names
TOUCHED = {"cfr_vru": "a pedestrian or cyclist", "cfr_object": "an object"}
Row = Mapping[str, Any]  # of rollouts.csv
Key = TypeVar("Key")


def plural(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"


def grouped(rows: Iterable[dict], key: Callable[[dict], Key]) -> dict[Key, list[dict]]:
    """The rows by their key, in the order of its first row."""
    groups: dict[Key, list[dict]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def traffic_name(row: Row) -> str:
    """Such as `e2 at η=2` or `nominal`."""
    return f"{row['method']} at η={row['eta']:g}" if row["eta"] else row["method"]


def headline_text(headline: Headline, ego: str, traffic: str) -> str:
    """The headline of an ego in a traffic, in a sentence or two."""
    where = f"{ego} under {traffic}"
    scenes = plural(headline.scenes, "scene")
    ways = f", in {plural(headline.ways, 'way')}" if headline.ways else ""
    effort = ""
    if headline.searches:
        effort = f", within {headline.tries:.1f} tries ({headline.nfe:.0f} NFE) a scene"
        if headline.searches > 1:
            effort += f" and each of {headline.searches} searches"
    if not headline.raised:
        return (
            f"{where}: preventable failures in {headline.preventable} of "
            f"{scenes}{ways}{effort}."
        )
    return (
        f"{where}: preventable failures, or it raised, in {headline.failed} of "
        f"{scenes}{effort}; preventable failures in {headline.preventable} of "
        f"{headline.scenes}{ways}; it raised in {headline.raised} of {headline.scenes}."
    )


def row_headline(row: Row) -> str:
    """The headline of a row of metrics.json, "" where it has none."""
    if not row.get("headline"):
        return ""
    headline = Headline(**row["headline"])
    return headline_text(headline, row["ego"], traffic=traffic_name(row))


def unit_of(row: Row, count: int = 2) -> str:
    """What the rates of events of a row of metrics.json are of, for so many of them."""
    if row.get("searched") and row["n_seeds"] > 1:
        return "searches of a scene"
    return ("scene" if row.get("searched") else "rollout") + "s" * (count != 1)


def errored_lines(rows: Sequence[dict], named: int = NAMED) -> list[str]:
    """What errored: how many rollouts, whose they are, and a line for each message and
    traffic with its scenes.

    Args:
        rows: of all rollouts.
        named: so many scenes of each line, and MESSAGES of the messages; 0: all.
    """
    lines = []
    kinds = {
        "The planner raised in {}, its failures:": raised,
        "The traffic raised in {}, left out:": lost,
    }
    for text, is_kind in kinds.items():
        errored = list(filter(is_kind, rows))
        if errored:
            share = f"{len(errored)} of {plural(len(rows), 'rollout')}"
            lines.append(text.format(share))
        groups = grouped(errored, lambda row: (row["error"], traffic_name(row)))
        ranked = sorted(groups.items(), key=lambda item: -len(item[1]))
        shown = MESSAGES if named else len(ranked)
        for (message, traffic), group in ranked[:shown]:
            scenes = scenes_text(group, named)
            lines.append(f"{message} ({len(group)} under {traffic}): {scenes}")
        if rest := len(ranked[shown:]):
            lines.append(f"and {plural(rest, 'other message')} in {ERRORED_FILE}")
    return lines


def touched_lines(rows: Iterable[dict], shown: bool = False) -> list[str]:
    """In how many rollouts each ego touched a pedestrian or cyclist, or an object, a
    line for each of the two where any did. Headlines, verdicts and failures are of
    contacts with vehicles.

    Args:
        rows: of all rollouts.
        shown: of a run with a failure report, which lacks them; else their scenes are
            named.
    """
    egos = grouped(rows, lambda row: row["ego_policy"])
    return [
        touched_text([row for row in group if row.get(column) in (0, 1)], column, shown)
        for column in TOUCHED
        for group in egos.values()
        if any(row.get(column) == 1 for row in group)
    ]


def touched_text(rows: Sequence[dict], column: str, shown: bool) -> str:
    """`touched_lines` of the rows of one ego, which know the column of TOUCHED."""
    attacks_first = sorted(rows, key=lambda row: not row["eta"])
    groups = grouped(attacks_first, traffic_name)
    touching = {
        name: [row for row in group if row[column] == 1]
        for name, group in groups.items()
    }
    names = [name for name in groups if touching[name] or len(groups) <= 2]
    counts = [
        f"{len(touching[name])} of {plural(len(groups[name]), 'rollout')} under {name}"
        for name in names
    ]
    text = f"{rows[0]['ego_policy']} touched {TOUCHED[column]} in {', '.join(counts)}"
    if shown:
        return f"{text}; the failure report lacks them, see {column} in {TABLE}."
    named = NAMED if len(names) <= 2 else MESSAGES
    places = [
        f"{name} in " * (len(names) > 1) + scenes_text(touching[name], named, TABLE)
        for name in names
        if touching[name]
    ]
    return f"{text}: {'; '.join(places)}."


def scenes_text(rows: Iterable[dict], named: int, file: str = ERRORED_FILE) -> str:
    """The scenes of rows with the seeds of each, such as `a (seeds 0, 1), b (seed 0)`;
    named: so many, 0: all; file: that has the others."""
    scenes = grouped(rows, lambda row: row["scene_id"])
    most = named or None
    texts = []
    for scene, group in list(scenes.items())[:most]:
        seeds = [str(row["seed"]) for row in group]
        rest = ", ..." * (0 < named < len(seeds))
        word = "seed" if len(seeds) == 1 else "seeds"
        texts.append(f"{scene} ({word} {', '.join(seeds[:most])}{rest})")
    others = len(scenes) - len(texts)
    rest = f" and {plural(others, 'other scene')} in {file}" if others else ""
    return ", ".join(texts) + rest
