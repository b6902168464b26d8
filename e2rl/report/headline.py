"""The headline and the errored rollouts in words, the same on the terminal, on the
pages, in gate and comparison."""

from collections.abc import Mapping, Sequence
from typing import Any

from e2rl.evaluation.headline import Headline
from e2rl.evaluation.rollout_files import ERRORED_FILE, TABLE
from e2rl.metrics.errored import lost, raised

NAMED, MESSAGES = 12, 3  # scenes of a message, and messages, that a summary names
TOUCHED = {"cfr_vru": "a pedestrian or cyclist", "cfr_object": "an object"}


def plural(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"


def traffic_name(row: Mapping[str, Any]) -> str:
    """Such as `e2 at η=2` or `nominal`."""
    return f"{row['method']} at η={row['eta']:g}" if row["eta"] else row["method"]


def headline_text(found: Headline, ego: str, traffic: str) -> str:
    """The headline of an ego in a traffic, in a sentence or two."""
    scenes = plural(found.scenes, "scene")
    ways = f", in {plural(found.ways, 'way')}" if found.ways else ""
    text = f"{ego} under {traffic}: preventable failures in {found.preventable} of {scenes}{ways}"
    if found.raised:
        text = f"{ego} under {traffic}: preventable failures, or it raised, in {found.failed} of {scenes}"
    if found.searches:
        searches = (
            "" if found.searches == 1 else f" and each of {found.searches} searches"
        )
        text += (
            f", within {found.tries:.1f} tries ({found.nfe:.0f} NFE) a scene{searches}"
        )
    if found.raised:
        text += f"; preventable failures in {found.preventable} of {found.scenes}{ways}"
        text += f"; it raised in {found.raised} of {found.scenes}"
    return f"{text}."


def unit_of(row: Mapping[str, Any], count: int = 2) -> str:
    """What the rates of events of a row of metrics.json are of, for so many of them."""
    if not row.get("searched"):
        return "rollout" if count == 1 else "rollouts"
    if row["n_seeds"] > 1:
        return "searches of a scene"
    return "scene" if count == 1 else "scenes"


def row_headline(row: Mapping[str, Any]) -> str:
    """The headline of a row of metrics.json, "" where it has none."""
    return (
        headline_text(
            Headline(**row["headline"]), row["ego"], traffic=traffic_name(row)
        )
        if row.get("headline")
        else ""
    )


def errored_lines(rows: Sequence[Mapping[str, Any]], named: int = NAMED) -> list[str]:
    """What errored: how many rollouts, whose they are, and a line for each message and
    traffic with its scenes.

    Args:
        rows: of all rollouts.
        named: so many scenes of each line, and MESSAGES of the messages; 0: all.
    """
    lines = []
    kinds = {
        "The planner raised in {}, its failures": raised,
        "The traffic raised in {}, left out": lost,
    }
    for text, errs in kinds.items():
        groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
        for row in filter(errs, rows):
            groups.setdefault((row["error"], traffic_name(row)), []).append(row)
        total = sum(map(len, groups.values()))
        lines += (
            [text.format(f"{total} of {plural(len(rows), 'rollout')}") + ":"]
            if total
            else []
        )
        ranked = sorted(groups.items(), key=lambda item: -len(item[1]))
        for (message, traffic), own in ranked[: MESSAGES if named else None]:
            lines.append(
                f"{message} ({len(own)} under {traffic}): {scenes_text(own, named)}"
            )
        if rest := len(ranked[MESSAGES:] if named else ()):
            lines.append(f"and {plural(rest, 'other message')} in {ERRORED_FILE}")
    return lines


def touched_lines(rows: Sequence[Mapping[str, Any]], shown: bool = False) -> list[str]:
    """In how many rollouts each ego touched a pedestrian or cyclist, or an object, a
    line for each of the two where any did. Headlines, verdicts and failures are of
    contacts with vehicles.

    Args:
        rows: of all rollouts.
        shown: of a run with a failure report, which lacks them; else their scenes are
            named.
    """
    return [
        touched_text(
            [
                row
                for row in rows
                if row["ego_policy"] == ego and row.get(column) in (0, 1)
            ],
            column,
            shown=shown,
        )
        for column in TOUCHED
        for ego in dict.fromkeys(
            row["ego_policy"] for row in rows if row.get(column) == 1
        )
    ]


def touched_text(rows: Sequence[Mapping[str, Any]], column: str, shown: bool) -> str:
    """`touched_lines` of the rows of one ego, which know the column of TOUCHED."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in sorted(
        rows, key=lambda row: not row["eta"]
    ):  # attacks before nominal traffic
        groups.setdefault(traffic_name(row), []).append(row)
    touching = {
        name: [row for row in own if row[column] == 1] for name, own in groups.items()
    }
    told = [name for name in groups if touching[name] or len(groups) <= 2]
    counts = [
        f"{len(touching[name])} of {plural(len(groups[name]), 'rollout')} under {name}"
        for name in told
    ]
    text = f"{rows[0]['ego_policy']} touched {TOUCHED[column]} in {', '.join(counts)}"
    if shown:
        return f"{text}; the failure report lacks them, see {column} in {TABLE}."
    named = NAMED if len(told) <= 2 else MESSAGES
    places = {
        name: scenes_text(touching[name], named, file=TABLE)
        for name in told
        if touching[name]
    }
    return f"{text}: {'; '.join(places.values() if len(told) == 1 else map(' in '.join, places.items()))}."


def scenes_text(
    rows: Sequence[Mapping[str, Any]], named: int, file: str = ERRORED_FILE
) -> str:
    """The scenes of rows with the seeds of each, such as `a (seeds 0, 1), b (seed 0)`;
    named: so many, 0: all; file: that has the others."""
    seeds: dict[str, list[int]] = {}
    for row in rows:
        seeds.setdefault(row["scene_id"], []).append(row["seed"])
    texts = []
    for scene, own in list(seeds.items())[: named or None]:
        shown = ", ".join(map(str, own[: named or None]))
        texts.append(
            f"{scene} ({'seed' if len(own) == 1 else 'seeds'} {shown}{', ...' * (0 < named < len(own))})"
        )
    rest = len(seeds) - len(texts)
    return ", ".join(texts) + (
        f" and {plural(rest, 'other scene')} in {file}" if rest else ""
    )
