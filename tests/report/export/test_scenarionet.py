"""ScenarioNet: the project's own reader gets back what was driven, where, and by what light."""

import pickle

import numpy as np
import pytest

from e2rl.scenes.recording import AGENT_TYPES, LIGHT_GREEN, LIGHT_RED
from e2rl.scenes.scenarionet import ScenarioNetSource
from tests.report.export.small_run import CUT_IN, exported, rollout_of


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    out = tmp_path_factory.mktemp("scenarionet") / "out"
    assert len(exported(run, out, "scenarionet")) == 2
    return out


@pytest.fixture(scope="module")
def recordings(folder):
    return list(ScenarioNetSource(str(folder)).recordings())


def test_tracks_come_back_to_the_centimetre_with_their_types(run, recordings):
    for index, recording in enumerate(recordings):
        rollout = rollout_of(run, index)
        rows = np.flatnonzero(rollout.valid.any(0))
        driven, valid = recording.states[recording.current :], recording.valid[recording.current :]
        assert recording.current == 10 and recording.ego == 0 and (valid == rollout.valid[:, rows]).all()
        np.testing.assert_allclose(driven[valid], rollout.states[:, rows][valid], atol=1e-4)
        np.testing.assert_allclose(recording.size, rollout.size[rows], atol=1e-4)
        assert [AGENT_TYPES[kind] for kind in recording.agent_type] == rollout.agent_type[rows].tolist()


def test_map_and_lights_come_back(recordings):
    lanes, lights = recordings[0].lanes, recordings[0].lights
    assert lanes["in"].exits == ["on", "left"] and lanes["near"].exits == []
    np.testing.assert_allclose([lanes["on"].speed_limit, lanes["on"].width], [20, 3.6], rtol=1e-5)
    np.testing.assert_allclose(lanes["in"].points[[0, -1]], [[-28, 0], [72, 0]], atol=1e-3)  # from the ego's start
    assert lights["on"].tolist() == [LIGHT_RED] * 40 + [LIGHT_GREEN] * 51 and set(lights["left"]) == {LIGHT_GREEN}


def test_descriptions_are_plain_and_zero_where_nobody_is(folder):
    """What MetaDrive's ScenarioDescription.sanity_check asks for."""

    def check(value):
        assert type(value) in (dict, list, str, int, float, bool, np.ndarray), type(value)
        for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
            check(part)

    for made in (pickle.loads(path.read_bytes()) for path in sorted(folder.glob("sd_*.pkl"))):
        check(made)
        assert made["metadata"]["ts"].shape == (made["length"],)
        for name, track in made["tracks"].items():
            assert track["metadata"]["object_id"] == name and track["state"]["valid"].any()
            for values in track["state"].values():
                assert len(values) == made["length"] and not np.any(values[~track["state"]["valid"]])
        facts = made["metadata"]["e2rl"]
        assert facts["scene_id"] in made["id"] and facts["adversaries"] == [CUT_IN]
