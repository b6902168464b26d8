"""The failure report: one HTML file that opens offline. `python -m e2rl.report.html RUN_DIR` writes failures.html.

It shows the failure modes, a replay of each failure, an index to search, the tables of the run and collisions over
realism. Everything is inside the file: no script, font or picture is loaded from elsewhere.
"""

import argparse
import hashlib
import html
import json
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

import e2rl
from e2rl.evaluation.modes import MODES_FILE, OTHER, read_modes
from e2rl.evaluation.rollout_files import METRICS_FILE, TABLE, nulls, read_metrics, read_rows
from e2rl.metrics.catalogue import METRICS
from e2rl.metrics.failure_modes import is_failure
from e2rl.report.failure_tracks import CHANNELS, MAP_QUANTUM, encoded_map, failure_replay
from e2rl.report.tables import column_names, read_tables
from e2rl.run.errors import InputError, stop
from e2rl.run.files import write_atomically
from e2rl.sim.rollouts import ROLLOUTS, Failure, rollout_name

PAGE = "failures.html"
ASSETS = Path(e2rl.__file__).parent / "assets" / "report"
GROUP = ("ego_policy", "method", "eta")
COLUMNS = (  # of rollouts.csv, in the page's index and facts
    *(*GROUP, "scene_id", "seed", "approach", "ego_manoeuvre", "partner_manoeuvre", "contact_type", "duty"),
    *("counted", "at_fault", "preventable", "avoidable", "avoidable_1s", "evasion_accel", "cfr_adv"),
    *("ego_speed", "partner_speed", "relvel", "contact_time"),
)
PLOTTED = ("cfr", "cfr_counted", "real", "real_adv")


def report(run: Path, replays: int, methods: Sequence[str] = ()) -> str:
    """The page of a run's folder, with the replays of at most so many failures; methods: only their failures."""
    content = page_content(run, replays, methods)
    data = json.dumps(nulls(content), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    scripts = sorted(ASSETS.glob("*.js"), key=lambda path: path.stem == "page")  # which uses all others
    parts = {
        "TITLE": html.escape(f"Failures of {', '.join(dict.fromkeys(group['ego'] for group in content['groups']))}"),
        "STYLE": (ASSETS / "page.css").read_text(),
        "SCRIPT": "\n".join(path.read_text() for path in scripts),
        "DATA": data,
    }
    before, *rest = (ASSETS / "page.html").read_text().split("{{")
    pieces = (piece.split("}}", 1) for piece in rest)
    return before + "".join(parts[name] + text for name, text in pieces)


def page_content(run: Path, replays: int, methods: Sequence[str] = ()) -> dict[str, Any]:
    """The data block of the page. Raises InputError where files of the run are missing or no method has the name."""
    if not run.is_dir():
        raise InputError(f"{run}: no such folder; give the folder of a run of evaluate.py")
    found, rows, metrics = read_modes(run / MODES_FILE), read_rows(run / TABLE), read_metrics(run / METRICS_FILE)
    if not found["groups"]:
        raise InputError(f"{run / TABLE}: no closed-loop rollouts; give the folder of a run of evaluate.py with some")
    known = dict.fromkeys(group["method"] for group in found["groups"])
    if wrong := [name for name in methods if name not in known]:
        raise InputError(f"--method {wrong[0]}: not in {run / TABLE}; choose among {', '.join(known)}")
    groups = [group for group in found["groups"] if not methods or group["method"] in methods]
    labels = dict(zip([group_key(group) for group in found["groups"]], column_names(found["groups"]), strict=True))
    chosen = {group_key(group) for group in groups}
    failures = [row for row in rows if is_failure(row) and group_key(row) in chosen]
    names = {mode["mode"]: mode["name"] for mode in found["modes"]}
    typical = {mode["typical"]["file"] for mode in found["modes"]}
    index = [failure(row, names, typical) for row in failures]
    first = metrics[0]
    return {
        "run": {name: first[name] for name in ("dataset", "split", "n_scenes", "n_seeds", "git", "command")},
        "groups": [
            {"ego": group["ego_policy"], "label": labels[group_key(group)], "method": group["method"]}
            | {name: group[name] for name in ("eta", "rollouts", "failures")}
            for group in groups
        ],
        "modes": names,
        "failures": index,
        "points": [plotted(row) for row in metrics if row.get("stage") is None],
        "tables": [vars(table) for table in read_tables(run / "tables.md")],
        "about": {metric.name: metric.about for metric in METRICS.values()},
        "channels": CHANNELS,
        "map_quantum": MAP_QUANTUM,
    } | add_replays(run, failures, index, replays)


def group_key(row: Mapping) -> tuple:
    return tuple(row[name] for name in GROUP)


def failure(row: Mapping, names: Mapping[int, str], typical: set[str]) -> dict[str, Any]:
    """What the page's index knows of a failure: COLUMNS, its mode (OTHER for small ones), and whether it is typical."""
    mode = int(row["mode"]) if row["mode"] in names else OTHER
    values = {name: round(row[name], 4) if isinstance(row[name], float) else row[name] for name in COLUMNS}
    return values | {"mode": mode, "typical": rollout_name(row) in typical}


def plotted(row: Mapping) -> dict[str, Any]:
    """A point of the plot of collisions over realism: the estimates PLOTTED of a row of metrics.json."""
    values = {name: row["metrics"][name] for name in PLOTTED if row["metrics"].get(name, {}).get("n")}
    return {"ego": row["ego"], "method": row["method"], "eta": row["eta"], "values": values}


def add_replays(run: Path, failures: Sequence[dict], index: Sequence[dict], count: int) -> dict[str, Any]:
    """`maps` and `replays` of the data block, for `count` failures; writes the number of its replay, or None, into each
    of `index`. Scenes share their map."""
    maps: dict[str, dict] = {}
    replays = []
    for entry in index:
        entry["replay"] = None
    for position in tqdm(replay_order(index)[:count], desc="replays", leave=False, disable=None):
        row = failures[position]
        failure = Failure.read(run, row)
        drawn = encoded_map(failure.rollout)
        key = hashlib.sha256(json.dumps(drawn).encode()).hexdigest()
        maps.setdefault(key, drawn)
        replays.append(failure_replay(failure) | {"map": list(maps).index(key)})
        index[position]["replay"] = len(replays) - 1
    return {"maps": list(maps.values()), "replays": replays}


def replay_order(index: Sequence[Mapping]) -> list[int]:
    """Positions of failures in the order in which they get a replay: the typical ones, then in turn one of each mode of
    each method."""
    seen: Counter[tuple] = Counter()
    turns = []
    for entry in index:
        key = (*group_key(entry), entry["mode"])
        turns.append(seen[key])
        seen[key] += 1
    return sorted(range(len(index)), key=lambda position: (not index[position]["typical"], turns[position], position))


def report_command(run: Path) -> str:
    """The command that writes the report of a run, "" where the run has no failure or kept no rollouts."""
    failures = read_modes(run / MODES_FILE)["failures"]
    return shlex.join(["python", "-m", "e2rl.report.html", str(run)]) if failures and (run / ROLLOUTS).is_dir() else ""


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m e2rl.report.html", description=__doc__.split("\n\n")[0])
    parser.add_argument("run", type=Path, metavar="RUN_DIR", help="folder of a run of evaluate.py")
    parser.add_argument("--replays", type=int, default=300, metavar="N", help="at most so many (default %(default)s)")
    parser.add_argument("--method", action="append", default=[], metavar="NAME", help="its failures only; repeatable")
    parser.add_argument("--out", type=Path, help=f"file to write (default: RUN_DIR/{PAGE})")
    options = parser.parse_args(arguments)
    path = options.out or options.run / PAGE
    try:
        write_atomically(path, report(options.run, options.replays, options.method))
    except InputError as error:
        stop(error)
    print(path)


if __name__ == "__main__":
    main()
