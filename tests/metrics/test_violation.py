"""What counts against an evasion is what DrivingEnv counts: contact with anyone, the road, nothing behind the map."""

import torch

from e2rl.metrics.manoeuvre import AWAY, EvasionScene, violations
from e2rl.sim.env import DrivingEnv, SimSettings
from tests.synthetic import LANE_WIDTH, make_scenes

SIZES = {"max_vehicles": 4, "max_agents": 6, "num_routes": 2, "num_points": 120}


def trajectories(scene, shift=0.0, speed=10.0, steps=40):
    """The ego [B, 1, T, 4] straight on at a speed, `shift` m beside its lane."""
    state = scene["start"][:, None, None, 0].repeat(1, 1, steps, 1)
    state[..., 0] += speed * 0.1 * torch.arange(1, steps + 1)
    state[..., 1] += shift
    state[..., 3] = speed
    return state


def evasion_scene(scene_set, moment=0):
    scene = scene_set.scenes
    return EvasionScene.after(torch.full((len(scene_set),), moment), scene, scene["logged"], scene["logged_valid"])


def test_contact_is_what_the_environment_calls_contact():
    scene_set = make_scenes(3, vehicles=[(0, 0, 10.0), (18, 0, 4.0)], num_vrus=0, steps=40, **SIZES)
    env = DrivingEnv(scene_set, SimSettings(end_on_contact=False), 3)
    td, hit = env.reset(), []
    for _ in range(40):
        td["action"] = torch.zeros(3, 2)
        after = env.step(td)["next"]
        hit.append(after["metrics", "contact"][:, 0])
        td = after.exclude("reward")
    missed = violations(trajectories(scene_set.scenes), evasion_scene(scene_set), 0.0, 0.0)[:, 0]
    assert torch.equal(missed > 0, torch.stack(hit, 1)) and (missed > 0).any()


def test_pedestrians_count_and_the_absent_do_not():
    scene_set = make_scenes(1, vehicles=[(0, 0, 10.0)], num_vrus=1, steps=40, **SIZES)
    scene_set.scenes["logged"][:, :, 4, 1] = 0.0
    ego = trajectories(scene_set.scenes)
    assert (violations(ego, evasion_scene(scene_set), 0.0, 0.0) > 0).any()
    scene_set.scenes["logged_valid"][:, :, 4] = False
    task = evasion_scene(scene_set)
    assert (violations(ego, task, 0.0, 0.0) == 0).all() and (task.others < AWAY).all()


def test_clearance_widens_and_the_road_ends_beside():
    scene_set = make_scenes(1, vehicles=[(0, 0, 10.0), (5, 1, 10.0)], num_vrus=0, steps=40, **SIZES)
    gap = LANE_WIDTH - 2.0
    task = evasion_scene(scene_set)
    assert (violations(trajectories(scene_set.scenes), task, gap - 0.05, 0.0) == 0).all()
    assert (violations(trajectories(scene_set.scenes), task, gap + 0.05, 0.0) > 0).any()
    assert (violations(trajectories(scene_set.scenes, shift=-4.5), task, 0.0, 0.0) > 1).all()
    edge = trajectories(scene_set.scenes, shift=-LANE_WIDTH / 2 - 0.7)  # 0.3 m inside the border
    assert (violations(edge, task, 0.0, 0.1) == 0).all()
    assert (violations(edge, task, 0.0, 0.5) > 0).all()


def test_nothing_counts_behind_the_map_s_end_or_after_the_episode():
    cars = [(0, 0, 10.0), (30, 0, 0.0)]
    for end, misses in ((400.0, True), (20.0, False)):
        scene_set = make_scenes(1, vehicles=cars, num_vrus=0, steps=40, road=(-60.0, end), **SIZES)
        assert (violations(trajectories(scene_set.scenes), evasion_scene(scene_set), 0.0, 0.0) > 0).any() == misses
    scene_set = make_scenes(1, vehicles=cars, num_vrus=0, steps=40, **SIZES)
    late = evasion_scene(scene_set, moment=30)
    assert late.inside.sum() == 10
    assert (violations(trajectories(scene_set.scenes), late, 0.0, 0.0)[..., 10:] == 0).all()
