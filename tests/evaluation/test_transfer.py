"""Sets of attacks and their files, and a matrix of known outcomes."""

from dataclasses import replace
from math import isnan

import pytest
import torch

from e2rl.evaluation.transfer import (
    AGAIN,
    ATTACK,
    REPLAY,
    AttackSet,
    Matrix,
    kept,
    named,
)
from e2rl.run.errors import InputError
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


@pytest.fixture
def file(tmp_path):
    return attack_set().write(tmp_path / "a.attacks")


def test_a_set_is_read_as_it_was_written(file):
    attacks = attack_set()
    result = AttackSet.read(file)
    assert result.rows == attacks.rows
    assert result.scenes == attacks.scenes
    assert torch.equal(result.tracks.nats, attacks.tracks.nats)


@pytest.mark.parametrize("place", [0, 20, 60, 0.3, 0.7, -1])
def test_a_changed_byte_is_refused(file, place):
    content = bytearray(file.read_bytes())
    index = int(place * len(content)) if isinstance(place, float) else place
    content[index] ^= 1
    file.write_bytes(content)
    with pytest.raises(InputError, match="no set of attacks"):
        AttackSet.read(file)


@pytest.mark.parametrize(
    "changes",
    [
        {"valid": torch.ones(3, FRAMES - 1, AGENTS, dtype=torch.bool)},
        {"nats": torch.zeros(2, 2)},
        {"routes": torch.zeros(3, AGENTS)},
        {"states": torch.zeros(3)},
    ],
)
def test_tracks_of_other_shapes_are_refused(tmp_path, changes):
    attacks = attack_set()
    attacks = replace(attacks, tracks=replace(attacks.tracks, **changes))
    with pytest.raises(InputError, match="no set of attacks"):
        AttackSet.read(attacks.write(tmp_path / "b.attacks"))


def test_each_attack_is_a_task_of_its_number():
    tasks = attack_set().tasks(scenes(3))
    assert [task.noise for task in tasks] == [0, 1, 2]
    assert [task.scene for task in tasks] == [0, 1, 2]


def test_other_scenes_are_refused():
    other = scenes(3)
    other.scenes["start"][1, 0, 3] += 1.0
    with pytest.raises(InputError, match=r"attacks on a: scene .* another"):
        attack_set().tasks(other)


def test_what_is_kept():
    rows = [
        {"errored": 0, "cfr": hit, "cfr_preventable": preventable}
        for hit, preventable in ((0, 0), (1, 0), (1, 1))
    ]
    rows.append({"errored": 1, "cfr": 1, "cfr_preventable": 1})
    assert kept(rows, "preventable") == rows[2:3]
    assert kept(rows, "hit") == rows[1:3]
    assert kept(rows, "all") == rows[:3]


# --- a matrix of known outcomes

OUTCOMES = {  # of three attacks: 0 no contact, 1 a contact, 2 a preventable one
    ("against-a", "a"): (2, 2, 2),
    ("against-a", "b"): (2, 1, 0),
    ("against-a", "c"): (0, 0, 0),
    ("against-b", "a"): (2, 2, 1),
    ("against-b", "b"): (2, 2, 2),
    ("against-b", "c"): (0, 1, 1),
}


@pytest.fixture
def matrix():
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


def test_a_cell_has_the_rates_of_its_attacks(matrix):
    for (method, ego), outcomes in OUTCOMES.items():
        name = method.removeprefix("against-")
        hit = matrix.rate(REPLAY, name, ego, "hit")
        preventable = matrix.rate(REPLAY, name, ego, "preventable")
        assert hit["mean"] == pytest.approx(sum(k > 0 for k in outcomes) / 3)
        assert preventable["mean"] == pytest.approx(sum(k > 1 for k in outcomes) / 3)
        assert hit["n"] == 3


@pytest.mark.parametrize(
    ("name", "ego", "expected"),
    [
        ("a", "", 1 / 6),
        ("b", "", 2 / 6),
        ("", "a", 2 / 3),
        ("", "b", 1 / 3),
        ("", "c", 0),
    ],
)
def test_sums_leave_a_planner_s_own_attacks_out(matrix, name, ego, expected):
    rate = matrix.rate(REPLAY, name, ego, "preventable")
    assert rate["mean"] == pytest.approx(expected)


def test_what_was_not_driven_is_not_known(matrix):
    assert isnan(matrix.rate(AGAIN, "a", "b", "hit")["mean"])


def test_the_nats_of_a_set_are_the_median(matrix):
    assert matrix.sets[0]["nats"] == 5.0


def test_the_matrix_is_read_as_it_was_written(matrix, tmp_path):
    matrix.write(tmp_path)
    result = Matrix.read(tmp_path)
    assert result.sets == matrix.sets
    assert result.rate(REPLAY, "b", "a", "hit") == matrix.rate(REPLAY, "b", "a", "hit")


def test_a_second_set_of_a_planner_has_a_name_of_its_own():
    names = named([attack_set("a"), attack_set("b"), attack_set("a")])
    assert list(names) == ["a", "b", "a-2"]
