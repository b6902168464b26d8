"""The stage that trains a prior: impossible settings, which scenes validate it, and its
closed loop on them."""

import pytest

from e2rl.learning.logging import RunLogger
from e2rl.learning.pretraining.prior.stage import _first_starts, run_prior_stage
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.run.run import Run
from tests.synthetic import make_scenes


@pytest.mark.parametrize(
    ("override", "what"),
    [
        ("stage.steps=0", "stage.steps=0"),
        ("prior.network.width=95", "multiple of heads=4"),
        ("stage.starts=[]", "stage.starts"),
    ],
)
def test_impossible_settings_are_named_before_anything_is_read(
    tmp_path, override, what
):
    config = load_config(
        "train", ["stage=prior", "data=scenarionet", "data.path=nowhere", override]
    )
    with pytest.raises(InputError, match=what):
        run_prior_stage(Run(config, tmp_path, choices={}), RunLogger("none", tmp_path))
    assert not list(tmp_path.iterdir())


def test_each_held_out_log_is_driven_from_its_earliest_start():
    scenes = make_scenes(6)
    scenes.scene_id[:] = ["a@30", "a@10", "b@10", "c@50", "c@30", "d@10"]
    scenes.location[:] = ["p", "p", "q", "p", "p", "q"]
    first = _first_starts(scenes)
    assert first.scene_id == ["a@10", "c@30"]
    assert first.location == ["p", "p"]
    assert len(first.scenes) == 2
