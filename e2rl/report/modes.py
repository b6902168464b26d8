"""The table of a run's failure modes, from its modes.json."""

from collections.abc import Mapping, Sequence

from e2rl.metrics.failure_modes import LEAST, MANY
from e2rl.report.tables import UNKNOWN, Table, column_names

COLUMNS = {"counted": "counts", "preventable": "preventable", "at_fault": "at fault", "avoidable": "avoidable"}
SPEEDS = {"ego_speed": "ego [m/s]", "partner_speed": "partner [m/s]"}


def mode_tables(found: Mapping) -> list[Table]:
    """The table "Failure modes of EGO" of a modes.json: a row for each mode, with its share of the failures of each
    method and intensity, verdicts and mean speeds; no table without failures."""
    if not found["modes"]:
        return []
    groups, modes = found["groups"], found["modes"]
    verdicts = {name: title for name, title in COLUMNS.items() if any(mode[name] is not None for mode in modes)}
    names = column_names(groups)
    rows = [
        [
            mode["name"] if mode["name"] == "other" else f"{mode['mode']}. {mode['name']}",
            str(mode["count"]),
            *(percent(group["share"]) for group in mode["groups"]),
            *(percent(mode[name]) for name in verdicts),
            *(UNKNOWN if mode[name] is None else f"{mode[name]:.1f}" for name in SPEEDS),
        ]
        for mode in modes
    ]
    rows.append(summary(found, len(verdicts)))
    head = ["", "failures", *(f"{name} [%]" for name in names)]
    head += [*(f"{title} [%]" for title in verdicts.values()), *SPEEDS.values()]
    return [Table(caption(found, [title for name, title in COLUMNS.items() if name not in verdicts]), head, rows)]


def summary(found: Mapping, verdicts: int) -> list[str]:
    """The last row: failures and modes of each group."""
    cells = [f"{group['failures']} in {group['modes']}" for group in found["groups"]]
    return ["all failures, in modes", str(found["failures"]), *cells, *[""] * (verdicts + len(SPEEDS))]


def caption(found: Mapping, absent: Sequence[str]) -> str:
    """What the table shows, and what was not known."""
    egos = ", ".join(dict.fromkeys(group["ego_policy"] for group in found["groups"]))
    text = (
        f"Failure modes of {egos}: share of each method's collisions; verdicts and mean speeds just before contact, of "
        f"the mode's collisions. Each word holds for two thirds of them; other: modes of less than {LEAST:.0%}, or of "
        f"one collision of {MANY} or more. `python -m e2rl.report.replay RUN_DIR --modes` draws a typical one of each."
    )
    if found["unknown"]:
        text += f" Grouped without {', '.join(found['unknown'])}, which the rollouts do not know."
    return text + (f" Not computable here: {', '.join(absent)}." if absent else "")


def percent(share: float | None) -> str:
    return UNKNOWN if share is None else f"{100 * share:.0f}"
