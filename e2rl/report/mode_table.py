"""The table of a run's failure modes, from its modes.json."""

from collections.abc import Mapping, Sequence

from e2rl.metrics.failure_modes import LEAST, MANY
from e2rl.report.tables import UNKNOWN, Table, column_names

COLUMNS = {"counted": "counts", "preventable": "preventable", "at_fault": "at fault", "avoidable": "avoidable"}
SPEEDS = {"ego_speed": "ego [m/s]", "partner_speed": "partner [m/s]"}


def mode_tables(found: Mapping) -> list[Table]:
    """The tables "Failure modes of EGO" of a modes.json, one for each ego: a row for each mode, with its share of the
    failures of each method and intensity, verdicts and mean speeds; no table without failures.

    Of several egos the modes are common, and so are their verdicts and speeds.
    """
    egos = dict.fromkeys(group["ego_policy"] for group in found["groups"])
    return [table for ego in egos if (table := mode_table(found, ego, len(egos) > 1)).rows]


def mode_table(found: Mapping, ego: str, several: bool) -> Table:
    """The table of one ego; several: there are other egos in the run."""
    chosen = [index for index, group in enumerate(found["groups"]) if group["ego_policy"] == ego]
    groups, modes = [found["groups"][index] for index in chosen], found["modes"]
    counts = [sum(mode["groups"][index]["count"] for index in chosen) for mode in modes]
    verdicts = {name: title for name, title in COLUMNS.items() if any(mode[name] is not None for mode in modes)}
    names = column_names(groups)
    rows = [
        [
            mode["name"] if mode["name"] == "other" else f"{mode['mode']}. {mode['name']}",
            str(count),
            *(percent(mode["groups"][index]["share"]) for index in chosen),
            *(percent(mode[name]) for name in verdicts),
            *(UNKNOWN if mode[name] is None else f"{mode[name]:.1f}" for name in SPEEDS),
        ]
        for mode, count in zip(modes, counts, strict=True)
        if count
    ]
    rows += [summary(groups, sum(counts), len(verdicts))] if rows else []
    head = ["", "failures", *(f"{name} [%]" for name in names)]
    head += [*(f"{title} [%]" for title in verdicts.values()), *SPEEDS.values()]
    absent = [title for name, title in COLUMNS.items() if name not in verdicts]
    return Table(caption(found, ego, several, absent), head, rows)


def summary(groups: Sequence[Mapping], failures: int, verdicts: int) -> list[str]:
    """The last row: failures and modes of each group."""
    cells = [f"{each['failures']} in {each['modes']} mode{'' if each['modes'] == 1 else 's'}" for each in groups]
    return ["all failures", str(failures), *cells, *[""] * (verdicts + len(SPEEDS))]


def caption(found: Mapping, ego: str, several: bool, absent: Sequence[str]) -> str:
    """What the table shows, and what was not known."""
    text = (
        f"Failure modes of {ego}: share of each method's collisions; verdicts and mean speeds just before contact, of "
        f"the mode's collisions{' with any ego' if several else ''}. Each word holds for two thirds of them; other: "
        f"modes of less than {LEAST:.0%}, or of one collision of {MANY} or more. `python -m e2rl.report.videos RUN_DIR "
        "--modes` draws a typical one of each."
    )
    if found["unknown"]:
        text += f" Grouped without {', '.join(found['unknown'])}, which the rollouts do not know."
    return text + (f" Not computable here: {', '.join(absent)}." if absent else "")


def percent(share: float | None) -> str:
    return UNKNOWN if share is None else f"{100 * share:.0f}"
