"""Coarse numbers of the bundled scenes beside recorded ones, as Markdown: python tools/compare_scenes.py LOGS

LOGS: a folder or zip of ScenarioDescription pickles. Vehicles of the start frame, the 32 nearest to the ego; the same
smoother and the same code for both sides; moving samples are faster than 0.5 m/s.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.stats import wasserstein_distance

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from scenegen.interaction import lateral_acceleration, overlapping_pairs

from e2rl.scenes.bundled import SPLITS, BundledSource
from e2rl.scenes.recording import DT, VEHICLE, Recording
from e2rl.scenes.scenarionet import ScenarioNetSource
from e2rl.scenes.smoothing import drop_jumps, smooth

MOVING, STEPS = 0.5, 80
ROWS = ("speed m/s", "a_lon m/s^2", "a_lat m/s^2")


def sample(recording: Recording) -> dict[str, np.ndarray]:
    """Moving samples of speed and accelerations, and a scene's counts."""
    now = recording.current
    apart = np.linalg.norm(recording.states[now, :, :2] - recording.states[now, recording.ego, :2], axis=-1)
    apart[~recording.valid[now] | (recording.agent_type != VEHICLE)] = np.inf
    rows = np.argsort(apart, kind="stable")[:32]
    rows = rows[np.isfinite(apart[rows])]
    valid = drop_jumps(recording.states[:, rows], recording.valid[:, rows])
    states = smooth(recording.states[:, rows], valid)
    states, valid = states[now : now + STEPS + 1], valid[now : now + STEPS + 1]
    speed = states[..., 3]
    lon = np.diff(speed, axis=0) / DT
    lat = lateral_acceleration(states, valid)[1:]
    both = valid[1:] & valid[:-1]
    travelled = np.where(both, np.linalg.norm(np.diff(states[..., :2], axis=0), axis=-1), 0.0).sum(0)
    driven = both & (speed[1:] > MOVING) & (travelled > 2.0)
    return {
        "speed m/s": speed[1:][driven],
        "a_lon m/s^2": lon[driven],
        "a_lat m/s^2": lat[driven],
        "agents": np.array([len(rows)]),
        "moving share": travelled > 2.0,
        "standing share": (speed[1:] < MOVING)[both & (travelled > 2.0)],
        "overlaps": np.array([len(overlapping_pairs(states, valid, recording.size[rows]))]),
    }


def pool(recordings) -> dict[str, np.ndarray]:
    """Samples of all recordings; "n": their number."""
    parts = [sample(recording) for recording in recordings]
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]} | {"n": np.array([len(parts)])}


def quantiles(values: np.ndarray) -> str:
    return " / ".join(f"{value:.2f}" for value in np.quantile(values, [0.01, 0.05, 0.5, 0.95, 0.99]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", help="folder or zip of recorded scenarios")
    options = parser.parse_args()
    logs = pool(ScenarioNetSource(options.logs).recordings())
    sets = {
        "bundled": pool(r for split in SPLITS for r in BundledSource(split=split).recordings()),
        "recorded": logs,
    }
    print("| | " + " | ".join(f"{name}, n = {part['n'][0]}" for name, part in sets.items()) + " |")
    print("|-|" + "-|" * len(sets))
    for row in ROWS:
        print(f"| {row}, q 1/5/50/95/99 | " + " | ".join(quantiles(part[row]) for part in sets.values()) + " |")
    for row in ROWS:
        gaps = [f"{wasserstein_distance(part[row], logs[row]):.3f}" for part in sets.values()]
        print(f"| {row}, W1 to recorded | " + " | ".join(gaps) + " |")
    for row in ("standing share", "moving share", "overlaps"):
        print(f"| {row} | " + " | ".join(f"{part[row].mean():.3f}" for part in sets.values()) + " |")
    counts = [" / ".join(f"{q:.0f}" for q in np.quantile(part["agents"], [0.1, 0.5, 0.9])) for part in sets.values()]
    print("| vehicles at the start, q 10/50/90 | " + " | ".join(counts) + " |")


if __name__ == "__main__":
    main()
