"""What a round of evolution looked like: one line, videos of attacks that hit the ego,
and the curriculum's choices."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from torch import Tensor

from e2rl.metrics.contact import first_contact
from e2rl.metrics.score import score_rollouts
from e2rl.report.picture import Replay
from e2rl.report.videos import save_animation
from e2rl.scenes.scene import SceneSet
from e2rl.sim.rollouts import Rollouts

METRES = 60.0  # side of a video's picture
PIXELS = 360  # the same


def round_line(metrics: Mapping[str, float], number: int, rounds: int) -> str:
    """A round in one line of at most 100 characters, errored rollouts apart."""
    hit = metrics.get("synthesizer/contact", float("nan"))
    left_out = metrics["synthesizer/left_out"]
    reasons = ", ".join(
        f"{count:.0f} {name.partition('/errored_')[2].replace('_', ' ')}"
        for name, count in metrics.items()
        if "/errored_" in name
    )
    errored = f", without a score: {reasons}" if reasons else ""
    left = f", {left_out:.0f} left out" if left_out else ""
    return (
        f"round {number}/{rounds}: the attacks hit in {hit:.0%} of "
        f"{metrics['synthesizer/scenes']:.0f} scenes{left} "
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
    for place, row in enumerate(hits(traffic, scenes)[:count].tolist(), 1):
        path = folder / "videos" / f"round-{number:03d}-{place}.gif"
        replay = replay_of(traffic, row, scenes=scenes, method=method)
        save_animation(path, replay.frames())
        yield path


def hits(traffic: Mapping[str, Tensor], scenes: SceneSet) -> Tensor:
    """Rows [H] of traffic in which an attack ended in a contact of the ego, one of a
    scene."""
    scene = scenes.batch(traffic["scene_index"])
    tracks = {
        "states": traffic["states"],
        "valid": traffic["valid"],
        "size": scene["size"],
        "agent_type": scene["agent_type"],
    }
    hit = first_contact(tracks)["hit"] & traffic["adversaries"].any(1)
    rows: dict[int, int] = {}  # of a scene
    for row in hit.nonzero()[:, 0].tolist():
        rows.setdefault(int(traffic["scene_index"][row]), row)
    return torch.tensor(list(rows.values()), dtype=torch.int64)


def replay_of(
    traffic: Mapping[str, Tensor], row: int, scenes: SceneSet, method: str
) -> Replay:
    """The replay of one row of a round's traffic.

    Args:
        traffic: of the memory.
        row: of the traffic.
        scenes: that it was driven in.
        method: name of the attack.
    """
    only = slice(row, row + 1)
    index = traffic["scene_index"][only]
    rollouts = Rollouts.in_scenes(
        scenes,
        index,
        states=traffic["states"][only],
        valid=traffic["valid"][only],
        adversaries=traffic["adversaries"][only],
        seed=index,
        eta=traffic["eta"][only].double().round(decimals=2),
        seconds=torch.zeros(1),
        dataset=[""],
        split=["train"],
        method=[method],
        ego_policy=["actor"],
    )
    rows, _ = score_rollouts(rollouts)
    return Replay(rollouts.rollout(0), rows[0], metres=METRES, pixels=PIXELS)
