"""Sets of scenes in memory are sliced, and scenes are checked by key."""

import pytest
import torch
from tensordict import TensorDict

from e2rl.run.errors import InputError
from e2rl.scenes.builder import BuildSettings, build_scene
from e2rl.scenes.scenarionet import recording_of
from e2rl.scenes.scene import SceneSet, validate
from tests.scenes.descriptions import description

SETTINGS = BuildSettings(field_cells=64)


def build(**options) -> TensorDict:
    return build_scene(recording_of(description(**options)), SETTINGS)


def test_the_set_is_sliced():
    several = torch.stack([build(), build()])
    several["scene_index"] = torch.arange(2)
    whole = SceneSet(
        several,
        ["a", "b"],
        location=["p", "q"],
        dataset="made",
        split="test",
        dropped={"invalid": 1},
    )
    assert len(whole) == 2
    assert whole.batch([1, 0, 1])["scene_index"].tolist() == [1, 0, 1]
    assert whole.steps == 80
    assert [part["scene_index"].tolist() for part in whole.parts(1)] == [[0], [1]]
    assert [whole.index(which) for which in (0, 1, "a", "b")] == [0, 1, 0, 1]
    for which in (2, -1, "c"):
        with pytest.raises(
            InputError,
            match=f"scene={which}: expected an index below 2 or the id of a scene",
        ):
            whole.index(which)
    first, other = whole.hashes()
    several["start"][1, 0, 3] += 1e-3
    assert first == other
    assert whole.hashes()[0] == first != whole.hashes()[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda scene: scene.set("start_accel", scene["start"]),
            "start_accel has not 1 dims",
        ),
        (lambda scene: scene["logged"].fill_(float("nan")), "logged .*holds NaN"),
        (
            lambda scene: scene["route_log"].fill_(-1),
            "the ego is absent or has no route",
        ),
    ],
)
def test_what_breaks_the_schema_is_named(change, message):
    scene = build()
    validate(scene, "x")
    change(scene)
    with pytest.raises(InputError, match=message):
        validate(scene, "x")
