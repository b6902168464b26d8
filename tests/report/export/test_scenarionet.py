"""ScenarioNet: the project's own reader gets back what was driven, where, and by what
light."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.report.export.episode import past_of, rollout_episode
from e2rl.report.export.scenarionet_writer import MAPPING, SUMMARY, description
from e2rl.scenes.recording import AGENT_TYPES, LIGHT_GREEN, LIGHT_RED
from e2rl.scenes.scenarionet import ScenarioNetSource
from e2rl.scenes.smoothing import PAST
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
        driven = recording.states[recording.current :]
        valid = recording.valid[recording.current :]
        assert recording.current == 10
        assert recording.ego == 0
        assert (valid == rollout.valid[:, rows]).all()
        np.testing.assert_allclose(
            driven[valid], rollout.states[:, rows][valid], atol=1e-4
        )
        np.testing.assert_allclose(recording.size, rollout.size[rows], atol=1e-4)
        assert [
            AGENT_TYPES[kind] for kind in recording.agent_type
        ] == rollout.agent_type[rows].tolist()


def test_map_and_lights_come_back(recordings):
    lanes = recordings[0].lanes
    lights = recordings[0].lights
    assert lanes["in"].exits == ["on", "left"]
    assert lanes["near"].exits == []
    np.testing.assert_allclose(
        [lanes["on"].speed_limit, lanes["on"].width], [20, 3.6], rtol=1e-5
    )
    np.testing.assert_allclose(
        lanes["in"].points[[0, -1]], [[-28, 0], [72, 0]], atol=1e-3
    )  # from the ego's start
    assert lights["on"].tolist() == [LIGHT_RED] * 40 + [LIGHT_GREEN] * 51
    assert set(lights["left"]) == {LIGHT_GREEN}


def test_descriptions_are_plain_and_zero_where_nobody_is(folder):
    """What MetaDrive's ScenarioDescription.sanity_check asks for."""

    def check(value):
        assert type(value) in (dict, list, str, int, float, bool, np.ndarray), type(
            value
        )
        for part in (
            value.values()
            if isinstance(value, dict)
            else value
            if isinstance(value, list)
            else ()
        ):
            check(part)

    for built in (
        pickle.loads(path.read_bytes()) for path in sorted(folder.glob("sd_*.pkl"))
    ):
        check(built)
        assert built["metadata"]["ts"].shape == (built["length"],)
        for name, track in built["tracks"].items():
            assert track["metadata"]["object_id"] == name
            assert track["state"]["valid"].any()
            for values in track["state"].values():
                assert len(values) == built["length"]
                assert not np.any(values[~track["state"]["valid"]])
        facts = built["metadata"]["e2rl"]
        assert facts["scene_id"] in built["id"]
        assert facts["adversaries"] == [CUT_IN]


def test_the_summary_counts_what_filters_ask_for(run, folder):
    summary = pickle.loads((folder / SUMMARY).read_bytes())
    assert list(summary) == list(pickle.loads((folder / MAPPING).read_bytes()))
    for index, (name, facts) in enumerate(summary.items()):
        built = pickle.loads((folder / name).read_bytes())
        rollout = rollout_of(run, index)
        numbers = facts["number_summary"]
        types = rollout.agent_type[rollout.valid.any(0)].tolist()
        assert facts["id"] == built["id"]
        assert (
            numbers["num_objects"]
            == len(types)
            == sum(numbers["num_objects_each_type"].values())
        )
        assert numbers["num_objects_each_type"]["VEHICLE"] == types.count("vehicle")
        assert numbers["num_moving_objects"] == len(types) - 1  # all but the box
        assert "OTHER" not in numbers["num_moving_objects_each_type"]
        assert numbers["num_traffic_lights"] == 2
        states = {"LANE_STATE_STOP": 40, "LANE_STATE_GO": 91 + 51}
        assert numbers["num_traffic_light_each_step"] == states
        assert numbers["num_map_features"] == len(built["map_features"])
        assert facts["map_height_diff"] == numbers["map_height_diff"] == 0


def test_polylines_have_three_coordinates(folder):
    for path in folder.glob("sd_*.pkl"):
        lanes = pickle.loads(path.read_bytes())["map_features"].values()
        assert all(
            lane["polyline"].shape[1] == 3 and not lane["polyline"][:, 2].any()
            for lane in lanes
        )


def test_who_reverses_has_a_velocity_against_the_heading(run):
    episode = rollout_episode(run, read_rows(run / TABLE)[0])
    states = episode.rollout.states.copy()
    states[:, 0, 2:] = [0.5, -2.0]
    backing = replace(episode, rollout=replace(episode.rollout, states=states))
    velocity = description(backing)["tracks"]["0"]["state"]["velocity"]
    np.testing.assert_allclose(
        velocity, [[-2 * np.cos(0.5), -2 * np.sin(0.5)]] * len(velocity), atol=1e-6
    )
    past = torch.zeros(1, PAST, 3)
    past[0, :, 0] = 0.2 * torch.arange(1, PAST + 1)  # 2 m/s backwards
    scene = TensorDict(
        {"start": torch.tensor([[1.0, 2.0, 0.5, -2.0]]), "past": past}, []
    )
    ((_, before),) = past_of(replace(episode, scene=scene))
    np.testing.assert_allclose(before[:, 3], -2.0, rtol=1e-5)
