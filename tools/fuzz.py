"""python tools/fuzz.py N [--data LOGS] [--seed S]: N malformed inputs for each reader, and counts by outcome.

Inputs are damaged copies of whole files: scenario pickles (structures and bytes), zips of them, rollout files, prior
checkpoints, actors, configurations of runs, lists of scenes and tables. Outcomes: `refused` (InputError, naming the
file), `read` (what is left is whole), `slow` (more than LIMIT seconds), and `escaped`: any other exception, which is a
fault of the program. The exit status is 1 where something escaped or was slow.
"""

import argparse
import copy
import io
import json
import pickle
import random
import sys
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from e2rl.api import load_config
from e2rl.ego.network import find_weights, read_actor
from e2rl.errors import InputError
from e2rl.evaluation.files import read_metrics
from e2rl.evaluation.rollout_reader import read_rollout
from e2rl.evaluation.table_comparison import compare_tables
from e2rl.prior.checkpoint import bundled_checkpoint, load_prior
from e2rl.resume import check_code, read_configuration
from e2rl.scene.build import BuildSettings, build_scene
from e2rl.scene.bundled import load_recordings
from e2rl.scene.recording import AGENT_TYPES, Recording
from e2rl.scene.scenarionet import ScenarioNetSource, read_recording, safe_load
from e2rl.scene.scene_list import COLUMNS, read_list

READERS = ("pickle_bytes", "structures", "archives", "rollouts", "checkpoints", "configurations")
READERS += ("scene_lists", "tables", "actors")  # methods of Readers
LIMIT = 20.0  # s for one input
SMALL = BuildSettings(steps=20, vehicles=4, others=2, field_cells=32)
ODD = [
    *(None, True, -1, 0, 2**63, 1e9, 1e300, float("nan"), float("inf"), "", "x" * 300, b"\0", [], {}, (), [[]], [None]),
    *(np.zeros(0), np.zeros((0, 3)), np.zeros((91, 1)), np.full((91, 3), np.nan), np.full(91, 1e9), np.array("x")),
    *(np.array([None, 1], object), np.arange(91)[::-1], np.ones((91, 3), bool), np.array(["a", "b"]), {"a": {"b": []}}),
]

ARRAYS = [odd for odd in ODD if isinstance(odd, float | str | np.ndarray) and np.asarray(odd).dtype.kind != "O"]


def description(recording: Recording) -> dict:
    """A recording as a ScenarioDescription."""
    states, valid = recording.states, recording.valid

    def track(index: int) -> dict:
        x, y, heading, speed = states[:, index].T
        state = {"position": np.stack([x, y, 0 * x], -1), "heading": heading, "valid": valid[:, index]}
        state |= {"velocity": speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)}
        state |= {name: np.full(len(x), recording.size[index, k]) for k, name in enumerate(("length", "width"))}
        return {"type": AGENT_TYPES[recording.agent_type[index]].upper(), "state": state}

    lanes = {
        name: {"type": "LANE_SURFACE_STREET", "polyline": lane.points, "exit_lanes": lane.exits, "width": np.zeros(0)}
        for name, lane in recording.lanes.items()
    }
    metadata = {"sdc_id": str(recording.ego), "ts": np.arange(len(states)) * 0.1, "current_time_index": 10}
    tracks = {str(index): track(index) for index in range(states.shape[1])}
    return {
        "id": recording.scene_id,
        "tracks": tracks,
        "map_features": lanes,
        "metadata": metadata,
        "dynamic_map_states": {},
    }


def mutated(data: Any, draw: random.Random) -> Any:
    """A copy of nested containers with one to three parts removed, replaced, or with a changed number."""
    data = copy.deepcopy(data)
    for _ in range(draw.randint(1, 3)):
        place, key = data, None
        while isinstance(place, dict | list) and place:
            parent, key = place, draw.choice(list(place) if isinstance(place, dict) else range(len(place)))
            place = parent[key]
            if draw.random() < 0.15:
                break
        if key is None:
            continue
        if isinstance(place, np.ndarray) and place.size and place.dtype.kind == "f" and draw.random() < 0.6:
            changed = place.copy()
            changed.flat[draw.randrange(place.size)] = draw.choice([np.nan, np.inf, 1e9, -1e300, 1e6, 0.0])
            parent[key] = draw.choice([changed, place[: len(place) // 2], place * 1e3, place[..., None], -place])
        elif draw.random() < 0.3 and isinstance(parent, dict):
            del parent[key]
        else:
            parent[key] = copy.deepcopy(draw.choice(ODD))
    return data


def damaged(content: bytes, draw: random.Random) -> bytes:
    """Bytes with some flipped, removed, repeated, or cut off."""
    changed = bytearray(content)
    for _ in range(draw.randint(1, 6)):
        where = draw.randrange(max(1, len(changed)))
        if draw.random() < 0.7 and changed:
            changed[where] = draw.randrange(256)
        elif draw.random() < 0.5:
            del changed[where : where + draw.randint(1, 64)]
        else:
            changed[where:where] = changed[where : where + draw.randint(1, 64)]
    return bytes(changed[: draw.randint(1, max(1, len(changed)))] if draw.random() < 0.2 else changed)


class Readers:
    """A reader by name: it makes an input, and reads it."""

    def __init__(self, scenes: list[dict], folder: Path, draw: random.Random) -> None:
        self.scenes, self.folder, self.draw = scenes, folder, draw
        self.pickles = [pickle.dumps(scene, protocol) for scene in scenes[:3] for protocol in (0, 2, 4)]
        self.prior = bundled_checkpoint().read_bytes()
        self.rollout = self._rollout()
        self.actor = find_weights("bundled").read_bytes()
        value = {"mean": 0.25, "low": 0.1, "high": None, "n": 4}
        self.table = [{"method": "e2", "eta": 2.0, "metrics": {"cfr": value}, "paired": {"nominal": {"cfr": value}}}]
        self.config = OmegaConf.to_container(load_config("train"))

    def _rollout(self) -> dict:
        states = np.zeros((21, 3, 4), np.float32)
        texts = {name: np.array("x") for name in ("scene_id", "location", "dataset", "split", "method", "ego_policy")}
        numbers = {"seed": np.array(0), "eta": np.array(0.0), "dt": np.array(0.1), "ego": np.array(0)}
        truths = {name: np.ones(3, bool) for name in ("simulated", "adversaries")}
        lines = {"lane_points": np.zeros((4, 2)), "lane_offsets": np.array([0, 4]), "lane_width": np.ones(1)}
        lines |= {"drivable_points": np.zeros((0, 2)), "drivable_offsets": np.array([0])}
        tracks = {
            "states": states,
            "logged": states,
            "valid": np.ones((21, 3), bool),
            "logged_valid": np.ones((21, 3), bool),
        }
        kinds = {"size": np.ones((3, 2)), "agent_type": np.array(["vehicle"] * 3), "format": np.array("e2rl-rollout/1")}
        return {**texts, **numbers, **truths, **lines, **tracks, **kinds}

    def pickle_bytes(self) -> None:
        safe_load(damaged(self.draw.choice(self.pickles), self.draw), "input")

    def structures(self) -> None:
        scene = pickle.dumps(mutated(self.draw.choice(self.scenes), self.draw))
        for recording in read_recording(scene, "input").windows(None, SMALL.steps):
            build_scene(recording, SMALL)

    def archives(self) -> None:
        buffer, path = io.BytesIO(), self.folder / "input.zip"
        method = self.draw.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
        with zipfile.ZipFile(buffer, "w", method) as archive:
            archive.writestr("a/one.pkl", self.pickles[0][:5000])
        path.write_bytes(damaged(buffer.getvalue(), self.draw))
        source = ScenarioNetSource(str(path))
        for log in source.logs():
            source.content(log)

    def rollouts(self) -> None:
        buffer, path = io.BytesIO(), self.folder / "input.npz"
        arrays = dict(self.rollout)
        if self.draw.random() < 0.5:
            arrays[self.draw.choice(list(arrays))] = np.asarray(self.draw.choice(ARRAYS))
        np.savez(buffer, **arrays)
        content = buffer.getvalue()
        path.write_bytes(content if self.draw.random() < 0.3 else damaged(content, self.draw))
        read_rollout(path)

    def checkpoints(self) -> None:
        path = self.folder / "input.safetensors"
        head = damaged(self.prior[:4000], self.draw) + self.prior[4000:]
        path.write_bytes(head if self.draw.random() < 0.8 else head[: self.draw.randrange(len(head))])
        load_prior(str(path))

    def configurations(self) -> None:
        path = self.folder / "config.yaml"
        content = OmegaConf.to_yaml(OmegaConf.create(self.config)).encode()
        path.write_bytes(damaged(content, self.draw))
        check_code(read_configuration(load_config("train"), path, "input"), [], "input")

    def scene_lists(self) -> None:
        path = self.folder / "input.csv"
        lines = [f"scene-{k},place,{k},{k:064x}" for k in range(20)]
        path.write_bytes(damaged("\n".join([",".join(COLUMNS), *lines]).encode(), self.draw))
        read_list(path)

    def tables(self) -> None:
        path = self.folder / "metrics.json"
        text = json.dumps(mutated(self.table, self.draw), default=str)
        path.write_bytes(text.encode() if self.draw.random() < 0.6 else damaged(text.encode(), self.draw))
        rows = read_metrics(path)
        compare_tables(rows, rows)

    def actors(self) -> None:
        path = self.folder / "input.safetensors"
        head = damaged(self.actor[:4000], self.draw) + self.actor[4000:]
        path.write_bytes(head if self.draw.random() < 0.8 else head[: self.draw.randrange(len(head))])
        read_actor(path)


def outcome(read: Callable[[], None]) -> str:
    """What came of one input."""
    begin = time.monotonic()
    try:
        read()
        result = "read"
    except InputError:
        result = "refused"
    except Exception:
        traceback.print_exc()
        result = "escaped"
    return "slow" if time.monotonic() - begin > LIMIT else result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("--data", help="a folder or zip of ScenarioDescription pickles; default: bundled scenes")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.data:
        source = ScenarioNetSource(options.data)
        scenes = [safe_load(source.content(log), log) for log in source.logs()[:8]]
    else:
        scenes = [description(recording) for recording in load_recordings("tune")[:8]]
    bad = 0
    with TemporaryDirectory() as folder:
        readers = Readers(scenes, Path(folder), random.Random(options.seed))
        for name in READERS:
            counts = Counter(outcome(getattr(readers, name)) for _ in range(options.count))
            bad += counts["escaped"] + counts["slow"]
            print(f"{name:15s}", ", ".join(f"{count} {what}" for what, count in sorted(counts.items())), flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
