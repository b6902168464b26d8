"""Scenes as one TensorDict: padded without changing what they hold, checked by key."""

import pickle

import pytest
import torch
from tensordict import TensorDict

from e2rl.errors import InputError
from e2rl.scene.build import BuildSettings, build_scene
from e2rl.scene.scenarionet import read_recording
from e2rl.scene.scene import KEYS, RAGGED, SceneSet, stack, validate
from tests.scene.descriptions import description, fork, lane

SETTINGS = BuildSettings(field_cells=64)


def build(**options) -> TensorDict:
    return build_scene(read_recording(pickle.dumps(description(**options)), "made"), SETTINGS)


@pytest.fixture(scope="module")
def scenes():
    return [build(), build(lanes=fork() | {"more": lane([[0, 30], [90, 30]], width=4.0)})]


def test_stacking_pads_ragged_keys_and_changes_nothing_else(scenes):
    both = stack(scenes)
    assert both.batch_size == torch.Size([2]) and both["scene_index"].tolist() == [0, 1]
    for row, scene in enumerate(scenes):
        for key in KEYS:
            value = both[key][row]
            inner = value[tuple(slice(0, size) for size in scene[key].shape)]
            assert torch.equal(inner, scene[key]) and value.dtype == scene[key].dtype, key
            if key in RAGGED and value.shape[0] > scene[key].shape[0]:
                assert (value[scene[key].shape[0] :] == RAGGED[key]).all(), key
    assert both["lane_width"].shape[1] == 5 and both["lane_width"][0, 4] == 0 and both["lane_width"][1, 4] == 4.0


def test_scenes_of_other_settings_are_no_set(scenes):
    recording = read_recording(pickle.dumps(description()), "made")
    with pytest.raises(InputError, match="same settings"):
        stack([scenes[0], build_scene(recording, BuildSettings(field_cells=64, vehicles=8))])


def test_the_set_is_sliced(scenes):
    whole = SceneSet(stack(scenes), ["a", "b"], ["p", "q"], "made", "test", {"invalid": 1})
    assert len(whole) == 2 and whole.first(None) is whole and whole.first(9) is whole
    first = whole.first(1)
    assert len(first) == 1 and first.scene_id == ["a"] and first.location == ["p"] and first.dropped == {"invalid": 1}
    assert whole.batch([1, 0, 1])["scene_index"].tolist() == [1, 0, 1]
    assert [whole.index(which) for which in (0, 1, "a", "b")] == [0, 1, 0, 1]
    for which in (2, -1, "c"):
        with pytest.raises(InputError, match=f"scene={which}: expected an index below 2 or the id of a scene"):
            whole.index(which)
    assert whole.to("cpu").scenes.device == torch.device("cpu")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda scene: scene.pop("field"), r"scene 'x'.*'field' is missing"),
        (lambda scene: scene.set("start_accel", scene["start"]), "start_accel has 2 dims, expected 1"),
        (lambda scene: scene["logged"].fill_(float("nan")), "logged holds NaN"),
        (lambda scene: scene["field"].fill_(float("inf")), "field holds NaN or infinite"),
        (lambda scene: scene["valid"].fill_(False), "the ego is absent or has no route"),
        (lambda scene: scene["route_log"].fill_(-1), "the ego is absent or has no route"),
    ],
)
def test_what_breaks_the_schema_is_named(scenes, change, message):
    scene = scenes[0].clone()
    validate(scene, "x")
    change(scene)
    with pytest.raises(InputError, match=message):
        validate(scene, "x")
