"""What a round of evolution looked like: one line, videos of attacks that hit the ego,
and the curriculum's choices."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from e2rl.metrics.contact import first_contact
from e2rl.metrics.score import score_rollouts
from e2rl.report.picture import Replay
from e2rl.report.videos import save_animation
from e2rl.scenes.scene import SceneSet
from e2rl.sim.rollouts import Rollouts

METRES, PIXELS = 60.0, 360  # side of a video's picture


def round_line(metrics: Mapping[str, float], number: int, rounds: int) -> str:
    """A round in one line of at most 100 characters, errored rollouts apart."""
    hit = metrics.get("synthesizer/contact", float("nan"))
    left_out = metrics["synthesizer/left_out"]
    found = {
        name.rpartition("/errored_")[2]: count
        for name, count in metrics.items()
        if "/errored_" in name
    }
    reasons = ", ".join(
        f"{count:.0f} {reason.replace('_', ' ')}" for reason, count in found.items()
    )
    errored = f", without a score: {reasons}" if reasons else ""
    left = f", {left_out:.0f} left out" if left_out else ""
    return (
        f"round {number}/{rounds}: the attacks hit in {hit:.0%} of {metrics['synthesizer/scenes']:.0f} scenes{left} "
        f"(eta {metrics['synthesizer/eta']:.2f}); {metrics['time/improve']:.0f} s learning{errored}"
    )


def save_videos(
    traffic: Mapping[str, Tensor],
    scenes: SceneSet,
    number: int,
    method: str,
    folder: Path,
    count: int,
) -> Iterator[Path]:
    """Write at most `count` videos of attacks in a round's traffic that hit the ego,
    videos/round-<number>-<k>.gif.

    Args:
        traffic: of the memory: scene_index [R], states [R, T+1, N, 4], valid,
            adversaries, eta.
        number: of the round, from 1.
        method: name of the attack, for the captions.

    Yields:
        The path of each video.
    """
    for k, row in enumerate(hits(traffic, scenes)[:count].tolist()):
        path = folder / "videos" / f"round-{number:03d}-{k + 1}.gif"
        save_animation(
            path, replay_of(traffic, row, scenes=scenes, method=method).frames()
        )
        yield path


def hits(traffic: Mapping[str, Tensor], scenes: SceneSet) -> Tensor:
    """Rows [H] of traffic in which an attack ended in a contact of the ego, one of a
    scene."""
    scene = scenes.batch(traffic["scene_index"])
    tracks = {name: traffic[name] for name in ("states", "valid")} | {
        name: scene[name] for name in ("size", "agent_type")
    }
    rows = (first_contact(tracks)["hit"] & traffic["adversaries"].any(1)).nonzero()[
        :, 0
    ]
    places = traffic["scene_index"][rows]
    first = [k for k in range(len(rows)) if places[k] not in places[:k]]
    return rows[first]


def replay_of(
    traffic: Mapping[str, Tensor], row: int, scenes: SceneSet, method: str
) -> Replay:
    """The replay of one row of a round's traffic."""
    shown = ("scene_index", "states", "valid", "adversaries")
    own: dict[str, Any] = {name: traffic[name][row : row + 1] for name in shown}
    index = own.pop("scene_index")
    about = {"dataset": "", "split": "train", "method": method, "ego_policy": "actor"}
    eta = traffic["eta"][row : row + 1].double().round(decimals=2)
    names: dict[str, Any] = {name: [value] for name, value in about.items()}
    rollouts = Rollouts.in_scenes(
        scenes, index, **own, seed=index, eta=eta, seconds=torch.zeros(1), **names
    )
    rows, _ = score_rollouts(rollouts)
    return Replay(rollouts.rollout(0), rows[0], metres=METRES, pixels=PIXELS)
