"""The matrix of planners and attacks in words and as tables."""

import math
from collections.abc import Mapping
from urllib.parse import quote

from e2rl.evaluation.transfer import MODES, REPLAY, Matrix
from e2rl.report.tables import UNKNOWN, Table
from e2rl.run.terminal import terminal_width

TITLES = {
    REPLAY: "attacks that drive as they did",
    "again": "attacks made anew against the planner of the row",
}
EXPLAINED = {
    REPLAY: "",
    "again": " Made anew: in the same scene, with the same noise and decisions, so that "
    "they follow who drives.",
}
WORDS = {"preventable": "Preventable failures", "hit": "Contacts"}
FACTS = ("attacks", "scenes", "nats")  # of a set; of nats the median
OTHERS = "others"  # heads the sums


def headline(matrix: Matrix) -> str:
    """Returns how far attacks carry over, from whom most, and whom they hit most."""

    def rate(name: str = "", ego: str = "") -> Mapping[str, float]:
        return matrix.rate(REPLAY, name, ego, "preventable")

    def share(name: str = "", ego: str = "") -> float:
        return rate(name, ego)["mean"] if rate(name, ego)["n"] else -1.0

    attacked = {entry["ego"] for entry in matrix.sets}
    others = [ego for ego in matrix.egos if ego not in attacked]
    none = f" No attacks are on {', '.join(others)}." if others else ""
    if share() <= 0:
        return f"No planner fails preventably in attacks on others.{none}"
    source = max((entry["name"] for entry in matrix.sets), key=share)
    driver = max(matrix.egos, key=lambda ego: share("", ego))
    return (
        f"Preventable failures in attacks on others: {percent(rate())}% of rollouts; most "
        f"in those on {source} ({counted(rate(source))}), most of {driver} "
        f"({counted(rate('', driver))}).{none}"
    )


def cross_tables(matrix: Matrix, narrow: bool = False) -> list[Table]:
    """Returns a table of each mode and event, with a row for each planner and a column
    for each set; narrow: without intervals, and where they would not fit the terminal,
    with numbers for names."""
    modes = dict.fromkeys(cell["mode"] for cell in matrix.cells)
    names = [entry["name"] for entry in matrix.sets]
    labels = {name: name for name in dict.fromkeys((*matrix.egos, *names))}
    width = sum(len(name) + 2 for name in (*names, OTHERS)) + max(map(len, labels))
    if narrow and width > terminal_width():
        labels = {name: str(number + 1) for number, name in enumerate(labels)}
    return [
        matrix_table(matrix, mode, event, labels=labels, narrow=narrow)
        for mode in modes
        for event in WORDS
    ]


def matrix_table(
    matrix: Matrix,
    mode: str,
    event: str,
    *,
    labels: Mapping[str, str],
    narrow: bool,
) -> Table:
    """Returns the rates of one event in one mode.

    Args:
        matrix: what it shows.
        mode: how the attacks drive.
        event: a key of WORDS.
        labels: of planners and sets.
        narrow: without intervals.
    """
    names = [entry["name"] for entry in matrix.sets]
    rows = []
    for ego in (*matrix.egos, ""):
        rates = [matrix.rate(mode, name, ego, event) for name in (*names, "")]
        label = labels[ego] if ego else OTHERS
        title = label if label in (ego, OTHERS) else f"{label} {ego}"
        rows.append([title, *(percent(rate, interval=not narrow) for rate in rates)])
    for fact in FACTS if event == "preventable" else ():
        rows.append([fact, *(amount(entry[fact]) for entry in matrix.sets), ""])
    caption = (
        f"{WORDS[event]}, % of {TITLES[mode]}. The row drives; the column is against whom "
        f"they were found; {OTHERS}: all but its own"
    )
    if narrow:
        caption += "."
    else:
        caption += (
            " [95% interval, by location or scene; none of few places]. nats: the median "
            "of the attacks."
        )
    caption += EXPLAINED[mode]
    links = [
        [f"#group={MODES[mode]}-{name}/{quote(ego)}" for name in names]
        for ego in matrix.egos
    ]
    heads = [labels[name] for name in names]
    return Table(caption, ["", *heads, OTHERS], rows=rows, links=links)


def counted(rate: Mapping[str, float]) -> str:
    """Returns a rate in per cent, and of how many rollouts."""
    return f"{percent(rate)}% of {rate['n']:.0f}"


def amount(value: float) -> str:
    """Returns a number in at most four characters up to a million."""
    return f"{value:.0f}" if value < 10_000 else f"{value / 1000:.0f}k"


def percent(rate: Mapping[str, float], interval: bool = False) -> str:
    """Returns a rate in per cent, on request with its interval."""
    if not rate["n"]:
        return UNKNOWN
    text = f"{rate['mean'] * 100:.0f}"
    if not interval or math.isnan(rate["low"]):
        return text
    return f"{text} [{rate['low'] * 100:.0f}, {rate['high'] * 100:.0f}]"
