"""Sets of attacks on synthetic scenes."""

import torch

from e2rl.evaluation.attack_set import ATTACK, AttackSet, named
from e2rl.evaluation.transfer import Matrix
from e2rl.scenes.scene_list import scene_hashes
from e2rl.traffic.attack_replay import AttackTracks
from tests.traffic.e2.traffic_scenes import scenes

FRAMES = 21
AGENTS = 10


def attack_set(ego="a", count=3):
    """A set of attacks, one in each of some scenes."""
    scene_set = scenes(count)
    row = {name: kind() for name, kind in ATTACK.items()}
    tracks = AttackTracks(
        states=torch.rand(count, FRAMES, AGENTS, 4),
        valid=torch.ones(count, FRAMES, AGENTS, dtype=torch.bool),
        adversaries=torch.zeros(count, AGENTS, dtype=torch.bool),
        routes=torch.zeros(count, AGENTS, dtype=torch.int64),
        nats=torch.tensor([[1.0, 2.0], [5.0, 0.0], [50.0, 50.0]])[:count],
    )
    hashes = scene_hashes(scene_set)
    return AttackSet(
        ego,
        rows=[row | {"scene_id": name} for name in scene_set.scene_id],
        tracks=tracks,
        scenes=dict(zip(scene_set.scene_id, hashes, strict=True)),
        origin={"git": "abc"},
    )


OUTCOMES = {  # of three attacks: 0 no contact, 1 a contact, 2 a preventable one
    ("against-a", "a"): (2, 2, 2),
    ("against-a", "b"): (2, 1, 0),
    ("against-a", "c"): (0, 0, 0),
    ("against-b", "a"): (2, 2, 1),
    ("against-b", "b"): (2, 2, 2),
    ("against-b", "c"): (0, 1, 1),
}


def known_matrix():
    """Planners a, b and c in attacks on a and b, with OUTCOMES."""
    rows = [
        {
            "method": method,
            "ego_policy": ego,
            "scene_id": f"s{seed}",
            "location": "",
            "seed": seed,
            "errored": 0,
            "cfr": float(outcome > 0),
            "cfr_preventable": float(outcome > 1),
        }
        for (method, ego), outcomes in OUTCOMES.items()
        for seed, outcome in enumerate(outcomes)
    ]
    sets = named([attack_set("a"), attack_set("b")])
    return Matrix.of(["a", "b", "c"], sets, rows)
