"""What a round of evolution looked like: films of attacks that hit the ego, and the curriculum's choices so far.

`train.py` draws them after every round; conf/logger says how many films, and on which dashboard they appear.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from e2rl.evaluation.rollout_files import Source, rollout_arrays
from e2rl.evaluation.rollout_reader import plain
from e2rl.learning.evolution import Evolution
from e2rl.learning.logging import RunLogger
from e2rl.metrics.contact import first_contact
from e2rl.metrics.score import score_rollouts
from e2rl.report.curriculum_figure import PICTURE, draw_choices
from e2rl.report.picture import Replay
from e2rl.report.videos import save_animation
from e2rl.scenes.recording import VEHICLE
from e2rl.scenes.scene import SceneSet
from e2rl.traffic.rollout import SCENE_KEYS

FILMS = "replays"
METRES, PIXELS = 60.0, 360  # side of a film's picture


def draw_round(run: Evolution, scenes: SceneSet, method: str, folder: Path, logger: RunLogger, replays: int) -> None:
    """Draw and log curriculum.png, and `replays` films of the attacks of the round just done: files
    replays/round-<number>-<k>.gif. Live traffic is not kept, so that there are none of it."""
    number = run.round
    draw_choices(folder)
    if (folder / PICTURE).is_file():
        logger.show("curriculum/choices", folder / PICTURE, number - 1)
    if not replays or not run.memory.rounds:
        return
    traffic = run.memory.rounds[-1].traffic
    for k, row in enumerate(hits(traffic, scenes)[:replays].tolist()):
        path = folder / FILMS / f"round-{number:03d}-{k + 1}.gif"
        path.parent.mkdir(exist_ok=True)
        save_animation(path, replay_of(traffic, row, scenes, method).frames())
        logger.show(f"synthesizer/replay_{k + 1}", path, number - 1)


def round_line(metrics: Mapping[str, float], number: int, rounds: int) -> str:
    """A round in one line."""
    speed, waiting = metrics.get("time/steps_per_second"), metrics.get("time/waiting")
    return (
        f"round {number}/{rounds}: eta {metrics['synthesizer/eta']:.2f}, adversarial collisions "
        f"{metrics.get('synthesizer/contact', float('nan')):.0%} in {metrics['synthesizer/scenes']:.0f} scenes "
        f"({metrics['synthesizer/left_out']:.0f} left out: no way found to avoid them), "
        f"{metrics['time/synthesize']:.0f} s synthesis, {metrics['time/improve']:.0f} s learning"
        + (f", {waiting:.0f} s waiting" if waiting is not None else "")
        + ended_text(metrics)
        + (f", collected at {speed:.0f} steps/s" if speed else "")
    )


def ended_text(metrics: Mapping[str, float]) -> str:
    """How many rollouts and episodes ended for an error, and why; "" for none."""
    found = {name.rpartition("/ended_")[2]: count for name, count in metrics.items() if "/ended_" in name}
    reasons = ", ".join(f"{count:.0f} {reason.replace('_', ' ')}" for reason, count in found.items())
    return f", without a score: {reasons}" if reasons else ""


def hits(traffic: Mapping[str, Tensor], scenes: SceneSet) -> Tensor:
    """Rows [H] of traffic in which an attack ended in a contact of the ego, one of a scene."""
    scene = scenes.batch(traffic["scene_index"])
    tracks = {name: traffic[name] for name in ("states", "valid")} | {
        name: scene[name] for name in ("size", "agent_type")
    }
    rows = (first_contact(tracks)["hit"] & traffic["adversaries"].any(1)).nonzero()[:, 0]
    places = traffic["scene_index"][rows]
    first = [k for k in range(len(rows)) if places[k] not in places[:k]]
    return rows[first]


def replay_of(traffic: Mapping[str, Tensor], row: int, scenes: SceneSet, method: str) -> Replay:
    """The replay of one row of a round's traffic."""
    index = traffic["scene_index"][row : row + 1]
    scene = scenes.batch(index)
    rollout: dict[str, Any] = {name: traffic[name][row : row + 1] for name in ("states", "valid", "adversaries")}
    rollout |= {name: scene[name] for name in SCENE_KEYS}
    slots = torch.arange(scene["valid"].shape[1]) < scene["route_points"].shape[1]
    rollout |= {
        "logged_valid": scene["logged_valid"] & scene["valid"][:, None],
        "simulated": scene["valid"] & (scene["agent_type"] == VEHICLE) & slots,
        "eta": traffic["eta"][row : row + 1].double().round(decimals=2),
        "seed": index,
        "seconds": torch.zeros(1),
        "scene_id": [scenes.scene_id[int(index)]],
        "location": [scenes.location[int(index)]],
    }
    rows, _ = score_rollouts(rollout)
    return Replay(plain(rollout_arrays(rollout, 0, Source("", "train", method, "actor"))), rows[0], METRES, PIXELS)
