"""The rollouts shown in the intensity figure: one scene and seed at every eta."""

from collections.abc import Sequence
from pathlib import Path

from e2rl.evaluation.files import ROLLOUTS, TABLE, read_rows, rollout_name


def intensity_ladder(folder: Path) -> list[Path]:
    """The rollout files, by eta, of the one (method, scene, seed) of a run's folder that best shows the effect of eta:
    no contact at the lowest eta, contact at as many others as possible, earlier at greater eta, late at first."""
    groups: dict[tuple, list[dict]] = {}
    for row in read_rows(Path(folder) / TABLE):
        groups.setdefault((row["method"], row["ego_policy"], row["scene_id"], row["seed"]), []).append(row)
    ladders = [sorted(group, key=lambda row: row["eta"]) for group in groups.values()]
    most = max(map(len, ladders))
    best = max((ladder for ladder in ladders if len(ladder) == most), key=worth)
    return [Path(folder) / ROLLOUTS / rollout_name(row) for row in best]


def worth(ladder: Sequence[dict]) -> tuple[float, ...]:
    """Score of rows of rollouts by eta for `intensity_ladder`; greater is better."""
    times = [row["contact_time"] for row in ladder if row["cfr"] == 1]
    falls = sum(later < earlier for earlier, later in zip(times, times[1:], strict=False))
    found = [row["cfr"] == 1 for row in ladder]
    monotone = found == sorted(found)
    return (not found[0], monotone, len(times), falls, times[0] - times[-1] if times else -ladder[-1]["min_dtc"])
