"""Sets of packed scenes are what the same set in memory is, whatever there is room for."""

import pickle

import pytest
import torch
from tensordict import TensorDict

from e2rl.run.errors import InputError
from e2rl.scenes.builder import BuildSettings, build_scene
from e2rl.scenes.scenarionet import read_recording
from e2rl.scenes.scene import KEYS, RAGGED, Loaded, SceneSet
from e2rl.scenes.scene_cache import Index, cached, pack
from tests.scenes.descriptions import description, fork, lane, straight

SETTINGS = BuildSettings(field_cells=64)


def build(x: float = 20.0, lanes=None, settings: BuildSettings = SETTINGS) -> TensorDict:
    tracks = {"ego": straight(x, 0, 8), "7": straight(50, 3.5, 6)}
    return build_scene(read_recording(pickle.dumps(description(tracks, lanes)), "made"), settings)


@pytest.fixture(scope="module")
def scenes() -> list[TensorDict]:
    wide = fork() | {"more": lane([[0, 30], [90, 30]], width=4.0)}
    return [build(20.0 + k, wide if k == 1 else None) for k in range(5)]


def packed_set(scenes, room: int) -> SceneSet:
    index, records = Index(split="test"), []
    for number, scene in enumerate(scenes):
        packed = pack({key: value.numpy() for key, value in scene.items()})
        index.add(f"scene-{number}", "here", packed)
        records.append(packed.record)
    return index.scenes(records, room)


def equal(row: TensorDict, scene: TensorDict) -> None:
    """A row is the scene, padded."""
    for key in KEYS:
        inner = row[key][tuple(map(slice, scene[key].shape))]
        assert torch.equal(inner, scene[key]) and row[key].dtype == scene[key].dtype, key
        if row[key].shape != scene[key].shape:
            assert key in RAGGED and (row[key][scene[key].shape[0] :] == RAGGED[key]).all(), key


@pytest.mark.parametrize("room", [1, 2, 5, 99])
def test_batches_are_the_scenes_padded_whatever_there_is_room_for(scenes, room):
    packed = packed_set(scenes, room)
    for wanted in ([0], [1, 0], [4, 1, 4], [2, 3, 0, 1, 4], [0, 0], [3]):
        batch = packed.batch(wanted)
        assert batch["scene_index"].tolist() == wanted and batch["lane_width"].shape[1] == 5
        for row, scene in zip(batch, wanted, strict=True):
            equal(row, scenes[scene])
    assert len(packed) == 5 and packed.steps == 80


@pytest.mark.parametrize("room", [1, 3, 5])
def test_a_running_batch_is_overwritten_row_by_row_or_whole(scenes, room):
    packed = packed_set(scenes, room)
    batch = packed.batch([0, 0, 0])
    packed.copy_into(batch, torch.tensor([0, 2]), torch.tensor([4, 1]))
    for row, scene in zip(batch, (4, 0, 1), strict=True):
        equal(row, scenes[scene])
    packed.copy_into(batch, torch.arange(3), torch.tensor([2, 3, 2]))
    for row, scene in zip(batch, (2, 3, 2), strict=True):
        equal(row, scenes[scene])


def test_batches_are_copies(scenes):
    packed = packed_set(scenes, 2)
    packed.batch([0])["start"].fill_(7.0)
    equal(packed.batch([0])[0], scenes[0])


def test_all_scenes_are_in_their_order_and_stay(scenes):
    packed = packed_set(scenes, 2)
    packed.batch([3]), packed.batch([1])
    whole = packed.scenes
    assert whole["scene_index"].tolist() == [0, 1, 2, 3, 4] and packed.scenes is whole
    for row, scene in zip(whole, scenes, strict=True):
        equal(row, scene)
    assert [part["scene_index"].tolist() for part in packed.parts(2)] == [[0, 1], [2, 3], [4]]


def test_chosen_scenes_are_those_of_the_set_and_hashed_alike(scenes):
    every = packed_set(scenes, 9)
    for room in (1, 9):
        some = packed_set(scenes, room).chosen([3, 1, 2]).chosen([2, 0])
        assert some.scene_id == ["scene-2", "scene-3"] and some.number == [2, 3]
        assert some.batch([1, 0])["scene_index"].tolist() == [1, 0]
        for row, scene in zip(some.scenes, (scenes[2], scenes[3]), strict=True):
            equal(row, scene)
        assert some.rows.hashes() == every.rows.hashes()[2:4] == Loaded(every.scenes).hashes()[2:4]
    assert len(set(every.rows.hashes())) == 5 and every.first(2).scene_id == ["scene-0", "scene-1"]


def test_what_is_sent_to_another_machine_is_the_set_alone(scenes, tmp_path):
    """Of a file that is mapped here, only the records that are needed."""

    def build(keep):
        index = Index(split="test")
        for number, scene in enumerate(scenes):
            packed = pack({key: value.numpy() for key, value in scene.items()})
            index.add(f"scene-{number}", "here", packed)
            keep(packed.record)
        return index

    some = cached(tmp_path / "scenes-a.packed", build, 2, 1).chosen([4, 1])
    some.batch([0, 1])
    sent = pickle.dumps(some)
    assert len(sent) < (tmp_path / "scenes-a.packed").stat().st_size / 2
    found = pickle.loads(sent)
    assert found.scene_id == some.scene_id and found.rows.hashes() == some.rows.hashes()
    for row, scene in zip(found.batch([0, 1]), (scenes[4], scenes[1]), strict=True):
        equal(row, scene)


def test_scenes_that_are_kept_are_not_unpacked_again(scenes):
    packed = packed_set(scenes, 2)
    packed.batch([0, 1])
    packed.rows.records = [b""] * 5
    assert packed.batch([1, 0])["scene_index"].tolist() == [1, 0]
    with pytest.raises(ValueError, match="cut short"):
        packed.batch([2])


def test_scenes_of_other_settings_are_no_set(scenes):
    other = build(settings=BuildSettings(field_cells=64, vehicles=8))
    with pytest.raises(InputError, match="equal settings"):
        packed_set([scenes[0], other], 2)
