"""CommonRoad: commonroad-io's reader gets back every state, and the schema holds."""

import copy
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("commonroad", reason="--to commonroad needs the extra commonroad")
import commonroad  # noqa: E402
from commonroad.common.reader.file_reader_xml import XMLFileReader  # noqa: E402
from lxml import etree  # noqa: E402

from e2rl.evaluation.rollout_files import TABLE, read_rows  # noqa: E402
from e2rl.report.export.commonroad_writer import beside, obstacles, side_by_side, write  # noqa: E402
from e2rl.report.export.episode import rollout_episode  # noqa: E402
from e2rl.report.export.scene_files import episodes_of  # noqa: E402
from e2rl.scenes.recording import Lane  # noqa: E402
from tests.report.export.small_run import CUT_IN, GAPS, LATE, exported, rollout_of  # noqa: E402

SCHEMA = (
    Path(commonroad.__file__).parent
    / "common"
    / "xml_definition_files"
    / "XML_commonRoad_XSD.xsd"
)


@pytest.fixture(scope="module")
def files(run, tmp_path_factory):
    return exported(run, tmp_path_factory.mktemp("commonroad") / "out", "commonroad")


@pytest.fixture(scope="module")
def scenarios(files):
    return [XMLFileReader(str(file)).open() for file in files]


def states_of(obstacle):
    return [obstacle.initial_state, *obstacle.prediction.trajectory.state_list]


def test_every_state_comes_back_and_no_other(run, scenarios):
    for index, (scenario, _) in enumerate(scenarios):
        rollout = rollout_of(run, index)
        count = len(rollout.size)
        observed = np.zeros(rollout.valid.shape, bool)
        for obstacle in scenario.dynamic_obstacles:
            row = (
                obstacle.obstacle_id - 1 if obstacle.obstacle_id <= count else LATE
            )  # which alone comes back
            for state in states_of(obstacle):
                x, y, heading, speed = rollout.states[state.time_step, row]
                turned = (heading - state.orientation + np.pi) % (2 * np.pi) - np.pi
                assert np.hypot(*(state.position - [x, y])) < 0.01
                assert abs(turned) < 1e-3
                assert abs(speed - state.velocity) < 0.01
                observed[state.time_step, row] = True
            assert np.allclose(
                [obstacle.obstacle_shape.length, obstacle.obstacle_shape.width],
                rollout.size[row],
            )
        single = rollout.valid.copy()
        single[:, [row for row in range(count) if row != LATE]] = False
        assert (
            observed
            == rollout.valid & ~(single & (np.arange(81) == GAPS[2][0])[:, None])
        ).all()


def test_files_follow_the_schema_but_for_late_starts(files):
    schema = etree.XMLSchema(etree.parse(str(SCHEMA)))
    for file in files:
        document = etree.parse(str(file))
        assert [float(document.findtext(f".//{axis}Translation")) for axis in "xy"] == [
            28,
            0,
        ]
        begins = document.findall(".//dynamicObstacle/initialState/time/exact")
        assert sorted(int(begin.text) for begin in begins)[-2:] == [
            GAPS[0][0],
            GAPS[1][0],
        ]
        prompt = copy.deepcopy(document)
        for begin in prompt.iterfind(".//dynamicObstacle/initialState/time/exact"):
            begin.text = "0"
        schema.assertValid(prompt)


def test_lanelets_lights_and_limits_come_back(scenarios):
    network = scenarios[0][0].lanelet_network
    lanes = {
        tuple(np.round(lane.center_vertices[-1] + [28, 0], 1).tolist()): lane
        for lane in network.lanelets
    }
    before, on, left = (lanes[end] for end in ((100, 0), (400, 0), (120, 320)))
    assert set(before.successor) == {
        on.lanelet_id,
        left.lanelet_id,
    }
    assert on.predecessor == [before.lanelet_id]
    assert before.left_vertices[0, 1] == pytest.approx(
        before.right_vertices[0, 1] + 3.6, abs=1e-3
    )
    lights = {light.direction.value: light for light in network.traffic_lights}
    steps = {
        name: [light.get_state_at_time_step(k).value for k in range(81)]
        for name, light in lights.items()
    }
    assert steps == {"straight": ["red"] * 30 + ["green"] * 51, "left": ["green"] * 81}
    limit = {
        float(sign.traffic_sign_elements[0].additional_values[0])
        for sign in network.traffic_signs
    }
    np.testing.assert_allclose(sorted(limit), [50 / 3.6, 20], rtol=1e-4)


def test_lights_before_a_fork_belong_to_an_intersection_that_says_where_each_way_leads(
    scenarios,
):
    network = scenarios[0][0].lanelet_network
    lanes = {
        tuple(np.round(lane.center_vertices[-1] + [28, 0], 1).tolist()): lane
        for lane in network.lanelets
    }
    before, on, left = (
        lanes[end].lanelet_id for end in ((100, 0), (400, 0), (120, 320))
    )
    (intersection,) = network.intersections
    (incoming,) = intersection.incomings
    assert incoming.incoming_lanelets == {before}
    assert incoming.outgoing_straight == {on}
    assert incoming.outgoing_left == {left}
    assert not incoming.outgoing_right


def test_neighbours_are_mutual():
    points = np.array([[0.0, 0.0], [50.0, 0.0]])
    lanes = {
        "a": Lane(points, left=["b"]),
        "b": Lane(points + [0, 3], right=["c"]),
        "c": Lane(points - [0, 3]),
    }
    assert beside(lanes, "a", side="left") is None
    lanes["b"].right.insert(0, "a")
    assert beside(lanes, "a", side="left") == "b"
    assert beside(lanes, "b", side="right") == "a"
    assert side_by_side(lanes, ["a", "c", "b"]) == [["c"], ["a", "b"]]


def test_the_mission_leads_from_the_start_to_where_the_recording_ends(run, scenarios):
    (problem,) = scenarios[0][1].planning_problem_dict.values()
    rollout = rollout_of(run, 0)
    np.testing.assert_allclose(
        problem.initial_state.position, rollout.states[0, 0, :2], atol=1e-3
    )
    (goal,) = problem.goal.state_list
    np.testing.assert_allclose(
        goal.position.rect_center.xy, rollout.logged[-1, 0, :2, None], atol=1e-3
    )


def test_a_start_in_a_bend_keeps_its_yaw_rate(run, tmp_path):
    """Though commonroad-io reads it only beside an acceleration."""
    episode = next(episodes_of(run, read_rows(run / TABLE)[:1], plugins=(), scene=True))
    episode.scene["start_yaw_rate"][0] = 0.3
    episode.scene["start_accel"][0] = -1.5
    ((_, path),) = write([episode], tmp_path)
    (problem,) = XMLFileReader(str(path)).open()[1].planning_problem_dict.values()
    assert problem.initial_state.yaw_rate == pytest.approx(0.3)
    assert problem.initial_state.acceleration == pytest.approx(-1.5)


def test_an_open_ego_is_a_planning_problem_only(run, tmp_path):
    scenario, problems = XMLFileReader(
        str(exported(run, tmp_path / "out", "commonroad", "--open-ego")[0])
    ).open()
    numbers = {obstacle.obstacle_id for obstacle in scenario.dynamic_obstacles}
    assert 1 not in numbers
    assert CUT_IN + 1 in numbers
    assert len(problems.planning_problem_dict) == 1


def test_who_reverses_has_a_negative_velocity(run):
    episode = rollout_episode(run, read_rows(run / TABLE)[0])
    states = episode.rollout.states.copy()
    states[:, 0, 3] = -2.0
    backing = replace(episode, rollout=replace(episode.rollout, states=states))
    ego = obstacles(backing, itertools.count(1000), open_ego=False)[0]
    assert [state.velocity for state in states_of(ego)] == [-2.0] * len(states)
