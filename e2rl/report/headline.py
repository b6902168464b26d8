"""The headline and the errored rollouts in words, the same on the terminal, on the pages, in gate and comparison."""

from collections.abc import Mapping, Sequence
from typing import Any

from e2rl.evaluation.headline import Headline
from e2rl.evaluation.rollout_files import ERRORED_FILE
from e2rl.metrics.errored import lost, raised

NAMED, MESSAGES = 4, 3  # rollouts of a message, and messages, that a summary names


def plural(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"


def traffic_name(row: Mapping[str, Any]) -> str:
    """Such as `e2 at η=2` or `nominal`."""
    return f"{row['method']} at η={row['eta']:g}" if row["eta"] else row["method"]


def headline_text(found: Headline, ego: str, traffic: str) -> str:
    """The headline of an ego in a traffic, in a sentence or two."""
    ways = f", in {plural(found.ways, 'way')}" if found.ways else ""
    text = (
        f"{ego} under {traffic}: preventable failures in {found.preventable} of {plural(found.scenes, 'scene')}{ways}"
    )
    if found.searches:
        searches = "" if found.searches == 1 else f" and each of {found.searches} searches"
        text += f", within {found.tries:.1f} tries ({found.nfe:.0f} NFE) a scene{searches}"
    if found.raised:
        text += f"; in {found.raised} the planner raised, in {found.failed} either"
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
    return headline_text(Headline(**row["headline"]), row["ego"], traffic_name(row)) if row.get("headline") else ""


def errored_lines(rows: Sequence[Mapping[str, Any]], named: int = NAMED) -> list[str]:
    """What errored, a sentence for each message: how many rollouts, whose they are, and `named` of them.

    Args:
        rows: of all rollouts.
        named: so many of each message; 0: all.
    """
    lines = []
    for errs, text in (
        (raised, "The planner raised in {}, its failures"),
        (lost, "The traffic raised in {}, left out"),
    ):
        groups: dict[str, list[Mapping[str, Any]]] = {}
        for row in filter(errs, rows):
            groups.setdefault(row["error"], []).append(row)
        total = sum(map(len, groups.values()))
        if total:
            count = f"{total} of {plural(len(rows), 'rollout')}"
            lines.append(f"{text.format(count)}:")
        ranked = sorted(groups.items(), key=lambda item: -len(item[1]))
        for message, own in ranked[: MESSAGES if named else None]:
            shown = own[: named or len(own)]
            names = "; ".join(f"{row['scene_id']} seed {row['seed']} {traffic_name(row)}" for row in shown)
            rest = len(own) - len(shown)
            more = f"; and {rest} more in {ERRORED_FILE}" if rest else ""
            lines.append(f"{message} ({len(own)}): {names}{more}")
    return lines
