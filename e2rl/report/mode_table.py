"""The table of a run's failure modes, from its modes.json."""

from collections.abc import Mapping

from e2rl.metrics.failure_modes import LEAST, MANY
from e2rl.report.tables import UNKNOWN, Table, column_names, plural

VERDICTS = {"counted": "counts", "preventable": "preventable", "at_fault": "at fault", "avoidable": "avoidable"}
SPEEDS = {"ego_speed": "ego [m/s]", "partner_speed": "partner [m/s]"}


def mode_tables(found: Mapping) -> list[Table]:
    """Returns a table of failure modes for each ego: a row for each mode, with its fraction of the failures of each
    method and intensity, verdicts and mean speeds; no table without failures.

    Of several egos the modes are common, and so are their verdicts and speeds.
    """
    egos = dict.fromkeys(group["ego_policy"] for group in found["groups"])
    return [table for ego in egos if (table := mode_table(found, ego, len(egos) > 1)).rows]


def mode_table(found: Mapping, ego: str, several: bool) -> Table:
    """The table of one ego; several: there are other egos in the run."""
    chosen = [index for index, group in enumerate(found["groups"]) if group["ego_policy"] == ego]
    groups = [found["groups"][index] for index in chosen]
    known = {name: title for name, title in VERDICTS.items() if any(mode[name] is not None for mode in found["modes"])}
    rows, failures = [], 0
    for mode in found["modes"]:
        if count := sum(mode["groups"][index]["count"] for index in chosen):
            failures += count
            fractions = [mode["groups"][index]["fraction"] for index in chosen] + [mode[name] for name in known]
            name = mode["name"] if mode["name"] == "other" else f"{mode['mode']}. {mode['name']}"
            speeds = [UNKNOWN if mode[name] is None else f"{mode[name]:.1f}" for name in SPEEDS]
            rows.append([name, str(count), *map(percent, fractions), *speeds])
    if rows:
        cells = [f"{each['failures']} in {plural(each['modes'], 'mode')}" for each in groups]
        rows.append(["all failures", str(failures), *cells, *[""] * (len(known) + len(SPEEDS))])
    columns = [*column_names(groups), *known.values()]
    head = ["", "failures", *(f"{name} [%]" for name in columns), *SPEEDS.values()]
    text = (
        f"Failure modes of {ego}: fraction of each method's collisions; verdicts and mean speeds just before contact, "
        f"of the mode's collisions{' with any ego' if several else ''}. Each word holds for two thirds of them; other: "
        f"modes of less than {LEAST:.0%}, or of one collision of {MANY} or more. `e2rl replay RUN_DIR --modes` draws a "
        "typical one of each."
    )
    if found["unknown"]:
        text += f" Grouped without {', '.join(found['unknown'])}, which the rollouts do not know."
    absent = [title for name, title in VERDICTS.items() if name not in known]
    return Table(text + (f" Not computable here: {', '.join(absent)}." if absent else ""), head, rows)


def percent(fraction: float | None) -> str:
    return UNKNOWN if fraction is None else f"{100 * fraction:.0f}"
