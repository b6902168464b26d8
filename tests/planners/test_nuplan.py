"""A planner of nuPlan's interface sees the scene as it is and drives where it plans to,
by the adapter in examples/.

The devkit is on no package index: a stand-in has what the adapter and the planners of
these tests import."""

import json
import math
import os
import sys
from pathlib import Path

import pytest
import torch

import e2rl
from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.protocol import run_protocol
from e2rl.evaluation.rollout_files import ERRORED_FILE
from e2rl.planners.external import ExternalEgo
from e2rl.scenes.bundled import BundledSource
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.mission import mission_of
from e2rl.sim.settings import SimSettings
from e2rl.sim.world import World
from e2rl.traffic.rule_based import LogReplay
from tests.planners.test_external import BAD, scene_set
from tests.synthetic import LANE_WIDTH, MARGIN, make_scenes

HERE = Path(__file__).parent
ADAPTER = HERE.parents[1] / "examples" / "nuplan_planner.py"
REAR = (
    0.2823 * 4.5
)  # m from the rear axle to the centre of the scenes' egos, in proportion to nuPlan's vehicle
LIT = (  # bundled scenes with lights on the ego's route
    "arterial_015_0720",
    "signalled_cross_018_0480",
    "signalled_cross_018_0680",
    "signalled_cross_041_0520",
    "signalled_cross_041_0760",
    "signalled_cross_041_0880",
    "signalled_cross_066_0520",
    "signalled_small_037_0600",
    "signalled_small_037_0240",
)
UNLIT = ("lane_drop_017_0440", "ramp_022_0200", "roundabout_014_0280")

LIGHTS = ("UNKNOWN", "RED", "YELLOW", "GREEN")  # by state


class Chosen(BundledSource):
    """Some of the bundled scenes."""

    def logs(self):
        return list(LIT + UNLIT)


@pytest.fixture
def nuplan(monkeypatch, tmp_path):
    """Returns the ego of a planner of nuplan_planners.py, with arguments."""
    return maker(monkeypatch, tmp_path)


@pytest.fixture(scope="module")
def bundled(tmp_path_factory):
    """Bundled scenes, and what a Witness sees at their start."""
    folder = tmp_path_factory.mktemp("bundled")
    scenes = Chosen(cache=str(folder / "cache"), workers=1).load().scenes
    with pytest.MonkeyPatch.context() as patch:
        ego = maker(patch, folder)("--planner nuplan_planners:Witness")
        ego.plan(World.at_start(scenes))
    return scenes, written(folder)


def maker(patch, folder):
    """Makes egos of planners, whose Witness writes into a folder."""
    path = os.pathsep.join([str(HERE / "nuplan_stand_in"), str(HERE)])
    patch.setenv("PYTHONPATH", path)
    patch.setenv("E2RL_WITNESS", str(folder / "seen"))

    def ego(planner, replan_every=1):
        return ExternalEgo(
            f"{sys.executable} {ADAPTER} {planner}",
            replan_every=replan_every,
            timeout=20.0,
        )

    return ego


@pytest.mark.parametrize("replan_every", [1, 5])
def test_a_planner_that_keeps_its_velocity_moves_as_at_constant_velocity(
    nuplan, replan_every
):
    """Whatever vehicle it plans for: the rear axle of its plan is that of the scene's
    ego."""
    scenes = make_scenes(2, steps=40)
    heading = torch.tensor([0.0, 0.4])
    scenes.scenes["start"][:, 0, 2] = scenes.scenes["logged"][:, 0, 0, 2] = heading
    start = scenes.scenes["start"][:, 0].clone()
    states = e2rl.roll_out(
        scenes,
        nuplan("--planner nuplan_planners:Straight", replan_every),
        traffic=LogReplay(),
    ).states
    expected = dynamics.constant_velocity(start, torch.tensor([4.0]))[:, 0]
    assert torch.allclose(states[:, 40, 0], expected, atol=2e-3)


@pytest.mark.parametrize("replan_every", [1, 5])
@pytest.mark.parametrize("acceleration", [1.0, -1.0])
def test_a_planner_of_poses_alone_moves_as_they_do_and_comes_softly_to_its_path(
    nuplan, replan_every, acceleration
):
    """From e beside the path a cubic of length S begins with curvature 6 e / S^2, which
    is its largest."""
    scenes = make_scenes(2, steps=51)
    beside = torch.tensor([1.0, -0.6])
    seconds = DT * torch.arange(51)
    scenes.scenes["start"][:, 0, 1] = scenes.scenes["logged"][:, 0, 0, 1] = beside
    ego = nuplan(
        f"--planner nuplan_planners:Centred acceleration={acceleration}", replan_every
    )
    states = e2rl.roll_out(scenes, ego, traffic=LogReplay()).states[:, :51, 0]
    speed = 10.0 + acceleration * seconds
    assert torch.allclose(states[..., 3], speed.expand(2, -1), atol=0.05)
    left = states[..., 1] / beside[:, None]
    assert left.max() < 1.001
    assert left.min() > -0.05
    assert left[:, 40:].abs().max() < 0.05
    sharpest = (
        states[..., 2].diff(dim=1).abs() / (DT * speed[1:]) / beside[:, None].abs()
    )  # 1/m, a metre beside
    assert sharpest.max() < 1.1 * 6 / (1.5 * 10.0) ** 2


@pytest.mark.parametrize("replan_every", [1, 5])
def test_it_sees_the_ego_and_everybody_else_where_they_are(
    nuplan, tmp_path, replan_every
):
    scenes = make_scenes(1, num_vrus=1, steps=40)
    scenes.scenes["start"][:, 1, 2] = 1.0  # one looks along no axis
    scenes.scenes["logged"][:, :, 1, 2] = 1.0
    rollouts = e2rl.roll_out(
        scenes,
        nuplan("--planner nuplan_planners:Witness", replan_every),
        traffic=LogReplay(),
    )
    observed = written(tmp_path)
    states = rollouts.states[0]
    assert [single["index"] for single in observed] == list(range(0, 40, replan_every))
    for single in observed[:: 20 // replan_every]:
        step = single["index"]
        x, y, heading, speed = states[step, 0].tolist()
        assert single["egos"][-1] == pytest.approx([x, y, heading, speed], abs=1e-4)
        back = (
            x - REAR * math.cos(heading),
            y - REAR * math.sin(heading),
            heading,
            -REAR * single["yaw_rate"],
        )
        assert single["rear"] == pytest.approx(back, abs=2e-3)
        assert single["size"] == [
            4.5,
            2.0,
        ]
        present = (rollouts.valid[0, step].nonzero()[:, 0].tolist())[1:]
        assert set(single["agents"]) == {f"agent-{k}" for k in present}
        for k in present:
            x, y, heading, speed = states[step, k].tolist()
            size = scenes.scenes["size"][0, k].tolist()
            velocity = [speed * math.cos(heading), speed * math.sin(heading)]
            assert single["agents"][f"agent-{k}"][:7] == pytest.approx(
                [x, y, heading, *velocity, *size], abs=1e-4
            )
            assert single["agents"][f"agent-{k}"][7] == (
                "PEDESTRIAN" if k >= 32 else "VEHICLE"
            )
    assert observed[-1]["yaw_rate"] == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize("replan_every", [1, 5])
def test_its_history_is_what_was_driven_and_before_that_steady(
    nuplan, tmp_path, replan_every
):
    scenes = make_scenes(1, steps=40)
    scenes.scenes["start_yaw_rate"][0, 0], scenes.scenes["start_accel"][0, 0] = (
        0.2,
        -1.0,
    )
    states = e2rl.roll_out(
        scenes,
        nuplan("--planner nuplan_planners:Witness", replan_every),
        traffic=LogReplay(),
    ).states[0, :, 0]
    first, *_, last = written(tmp_path)
    for single in (first, last):
        assert len(single["egos"]) == len(single["before"]) == 21
        assert single["interval"] == DT
        assert {
            later - earlier
            for earlier, later in zip(
                single["times"], single["times"][1:], strict=False
            )
        } == {100_000}
    came = states[last["index"] - 20 : last["index"] + 1]
    tolerance = (
        1e-4 if replan_every == 1 else 0.03
    )  # between two plans it is interpolated
    assert torch.allclose(torch.tensor(last["egos"]), came, atol=tolerance)
    past = torch.tensor(first["egos"])
    assert torch.allclose(past[-1], states[0], atol=1e-5)
    steady = torch.tensor([0.0, 0.2]).expand(
        20, 2
    )  # from where it was 2 s ago, it arrives
    assert torch.allclose(
        dynamics.rollout(past[:1], steady[None])[0], past[1:], atol=2e-2
    )


def written(folder):
    """What a Witness saw, a dict a plan."""
    return [json.loads(line) for line in (folder / "seen").read_text().splitlines()]


def test_lanes_of_the_map_hold_the_ego_and_lead_along_its_route(bundled):
    scenes, observed = bundled
    mission = mission_of(scenes)
    assert len(observed) == len(scenes) == len(LIT + UNLIT)
    for row, single in enumerate(observed):
        assert single["on"]
        assert set(single["on"]) <= set(single["near"])
        assert single["drivable"]
        route = [lane["id"] for block in single["route"] for lane in block]
        assert set(route) & set(single["near"]), row
        assert all(single["linked"]), row
        assert (torch.tensor(single["goal"][:2]) - mission.points[row]).norm(
            dim=-1
        ).min() < 1e-3
    limits = {
        lane["limit"]
        for single in observed
        for block in single["route"]
        for lane in block
    }
    inputs = mission.limit[mission.limit > 0].unique().tolist()
    assert limits - {None}
    assert all(min(abs(limit - k) for k in inputs) < 1e-4 for limit in limits - {None})


def test_lights_of_the_route_are_those_of_the_lanes_that_begin_there(bundled):
    scenes, observed = bundled
    mission = mission_of(scenes)
    checked = 0
    for row, column in (mission.light >= 0).nonzero().tolist():
        light = int(mission.light[row, column])
        begin = scenes["light_points"][row, light].tolist()
        state = int(scenes["light_state"][row, 0, light])
        status = {name: content for content, name in observed[row]["lights"]}
        lanes = [
            lane
            for block in observed[row]["route"]
            for lane in block
            if math.dist(lane["begin"][:2], begin) < 0.5
        ]
        assert not lanes or LIGHTS[state] in [status.get(lane["id"]) for lane in lanes]
        checked += bool(lanes)
    assert checked >= 9


def test_lanes_side_by_side_are_a_roadblock(nuplan, tmp_path):
    scenes = make_scenes(1, limit=12.0)
    nuplan("--planner nuplan_planners:Witness").plan(World.at_start(scenes.scenes))
    (single,) = written(tmp_path)
    (left, right), half = single["route"][0], LANE_WIDTH / 2
    assert (left["id"], left["index"], left["right"], left["left"]) == (
        "1",
        1,
        "0",
        None,
    )
    assert (right["id"], right["index"], right["left"], right["right"]) == (
        "0",
        2,
        "1",
        None,
    )
    for lane in (left, right):
        assert lane["limit"] == 12.0
        assert lane["width"] == pytest.approx(LANE_WIDTH, rel=0.01)
        assert lane["borders"] == pytest.approx([half, -half], abs=1e-3)
        assert lane["turns"] == pytest.approx(0.0, abs=1e-6)


def test_the_road_reaches_as_far_beside_the_lanes_as_the_metrics_have_it(
    nuplan, tmp_path
):
    scenes = make_scenes(1)
    nuplan("--planner nuplan_planners:Witness").plan(World.at_start(scenes.scenes))
    (single,) = written(tmp_path)
    border = -LANE_WIDTH / 2, 1.5 * LANE_WIDTH
    for aside, drivable, lane, beside in single["aside"]:
        beyond = max(border[0] - aside, aside - border[1])  # m outside of the lanes
        if min(abs(beyond), abs(beyond - MARGIN), abs(aside - LANE_WIDTH / 2)) > 0.1:
            assert (drivable, lane, beside) == (
                beyond < MARGIN,
                beyond < 0,
                0 < beyond < MARGIN,
            ), aside


WRONG = {
    "raises": ("PlannerFailed", "RuntimeError: no way out (nuplan_planners.py, line"),
    "velocities": (
        "PlannerFailed",
        "the trajectory's poses move 50.0 m, its rear-axle velocities 5.0 m",
    ),
    "elsewhere": ("PlannerFailed", "the trajectory begins 20.0 m from the ego"),
    "short": ("BadReply", "fewer than the 5 steps until the next plan"),
}


@pytest.mark.parametrize("how", WRONG)
def test_what_goes_wrong_in_a_scene_costs_that_scene_and_is_told(nuplan, tmp_path, how):
    ego = nuplan(f"--planner nuplan_planners:Wrong how={how} bad=3.5", replan_every=5)
    setup = Setup(
        scene_set(),
        ego,
        ego_name="nuplan",
        sim=SimSettings(),
        batch=4,
    )
    (row,) = run_protocol(
        setup,
        [Method("replay", LogReplay())],
        seeds=[0],
        folder=tmp_path,
    )
    (entry,) = json.loads((tmp_path / ERRORED_FILE).read_text())
    reason, detail = WRONG[how]
    assert row["errored"] == {f"raised {reason}": 1}
    assert row["n_rollouts"] == 4
    assert entry["scene_id"] == scene_set().scene_id[BAD]
    assert detail in entry["detail"]


def test_a_planner_of_cameras_is_refused(nuplan):
    with pytest.raises(
        Exception, match="Camera observes Sensors; e2rl has DetectionsTracks only"
    ):
        nuplan("--planner nuplan_planners:Camera").plan(
            World.at_start(make_scenes(1).scenes)
        )


def test_a_configuration_of_the_devkit_names_the_planner(nuplan, tmp_path):
    (tmp_path / "planner.yaml").write_text(
        "mine:\n  _target_: nuplan_planners.Straight\n  seconds: 2.0\n"
    )
    ego = nuplan(f"--config {tmp_path / 'planner.yaml'}")
    world = World.at_start(make_scenes(1).scenes)
    plan = ego.plan(world)
    expected = dynamics.constant_velocity(world.states[:, 0], torch.tensor([5.0]))[:, 0]
    assert torch.allclose(plan[:, -1], expected, atol=1e-3)
