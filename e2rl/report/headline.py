"""The headline and the errored rollouts in words, the same on the terminal, on the pages, in gate and comparison."""

from collections.abc import Mapping, Sequence
from typing import Any

from e2rl.evaluation.headline import Headline
from e2rl.evaluation.rollout_files import ERRORED_FILE
from e2rl.metrics.errored import lost, raised

NAMED, MESSAGES = 12, 3  # scenes of a message, and messages, that a summary names


def plural(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"


def traffic_name(row: Mapping[str, Any]) -> str:
    """Such as `e2 at η=2` or `nominal`."""
    return f"{row['method']} at η={row['eta']:g}" if row["eta"] else row["method"]


def headline_text(found: Headline, ego: str, traffic: str) -> str:
    """The headline of an ego in a traffic, in a sentence or two."""
    scenes, ways = plural(found.scenes, "scene"), f", in {plural(found.ways, 'way')}" if found.ways else ""
    text = f"{ego} under {traffic}: preventable failures in {found.preventable} of {scenes}{ways}"
    if found.raised:
        text = f"{ego} under {traffic}: preventable failures, or it raised, in {found.failed} of {scenes}"
    if found.searches:
        searches = "" if found.searches == 1 else f" and each of {found.searches} searches"
        text += f", within {found.tries:.1f} tries ({found.nfe:.0f} NFE) a scene{searches}"
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
    return headline_text(Headline(**row["headline"]), row["ego"], traffic_name(row)) if row.get("headline") else ""


def errored_lines(rows: Sequence[Mapping[str, Any]], named: int = NAMED) -> list[str]:
    """What errored: how many rollouts, whose they are, and a line for each message and traffic with its scenes.

    Args:
        rows: of all rollouts.
        named: so many scenes of each line, and MESSAGES of the messages; 0: all.
    """
    lines = []
    kinds = {"The planner raised in {}, its failures": raised, "The traffic raised in {}, left out": lost}
    for text, errs in kinds.items():
        groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
        for row in filter(errs, rows):
            groups.setdefault((row["error"], traffic_name(row)), []).append(row)
        total = sum(map(len, groups.values()))
        lines += [text.format(f"{total} of {plural(len(rows), 'rollout')}") + ":"] if total else []
        ranked = sorted(groups.items(), key=lambda item: -len(item[1]))
        for (message, traffic), own in ranked[: MESSAGES if named else None]:
            lines.append(f"{message} ({len(own)} under {traffic}): {scenes_text(own, named)}")
        if rest := len(ranked[MESSAGES:] if named else ()):
            lines.append(f"and {plural(rest, 'other message')} in {ERRORED_FILE}")
    return lines


def scenes_text(rows: Sequence[Mapping[str, Any]], named: int) -> str:
    """The scenes of rows with the seeds of each, such as `a (seeds 0, 1), b (seed 0)`; named: so many, 0: all."""
    seeds: dict[str, list[int]] = {}
    for row in rows:
        seeds.setdefault(row["scene_id"], []).append(row["seed"])
    texts = []
    for scene, own in list(seeds.items())[: named or None]:
        shown = ", ".join(map(str, own[: named or None]))
        texts.append(f"{scene} ({'seed' if len(own) == 1 else 'seeds'} {shown}{', ...' * (0 < named < len(own))})")
    rest = len(seeds) - len(texts)
    return ", ".join(texts) + (f" and {plural(rest, 'other scene')} in {ERRORED_FILE}" if rest else "")
