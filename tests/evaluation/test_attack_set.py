"""Sets of attacks: their files, their scenes and their names."""

from dataclasses import replace

import pytest
import torch

from e2rl.evaluation.attack_set import AttackSet, kept, named
from e2rl.run.errors import InputError
from e2rl.scenes.scene_list import scene_hashes
from tests.evaluation.attack_sets import AGENTS, FRAMES, attack_set
from tests.traffic.e2.traffic_scenes import scenes


def check(scene_set, sizes=(FRAMES, AGENTS)):
    hashes = dict(zip(scene_set.scene_id, scene_hashes(scene_set), strict=True))
    attack_set().check_scenes(hashes, sizes)


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


def test_its_own_scenes_are_taken():
    check(scenes(3))


@pytest.mark.parametrize("sizes", [(FRAMES + 1, AGENTS), (FRAMES, AGENTS - 1)])
def test_scenes_of_other_sizes_are_refused(sizes):
    with pytest.raises(InputError, match="attacks on a: frames and agents"):
        check(scenes(3), sizes)


def test_other_scenes_are_refused():
    other = scenes(3)
    other.scenes["start"][1, 0, 3] += 1.0
    with pytest.raises(InputError, match=r"attacks on a: scene .* another"):
        check(other)


def test_what_is_kept():
    rows = [
        {"errored": 0, "cfr": hit, "cfr_preventable": preventable}
        for hit, preventable in ((0, 0), (1, 0), (1, 1))
    ]
    rows.append({"errored": 1, "cfr": 1, "cfr_preventable": 1})
    assert kept(rows, "preventable") == rows[2:3]
    assert kept(rows, "hit") == rows[1:3]
    assert kept(rows, "all") == rows[:3]


def test_a_second_set_of_a_planner_has_a_name_of_its_own():
    names = named([attack_set("a"), attack_set("a-2"), attack_set("a")])
    assert list(names) == ["a", "a-2", "a-3"]
