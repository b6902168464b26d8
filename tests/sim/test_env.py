"""DrivingEnv: specs, partial resets, one scene per trajectory, seeds, given traffic,
contact, off-road, map ends."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from e2rl.run.errors import InputError
from e2rl.scenes.recording import DT, OTHER
from e2rl.sim.env import DrivingEnv
from e2rl.sim.settings import SimSettings
from e2rl.sim.world import World
from tests.synthetic import make_scenes

METRIC_KEYS = [
    ("metrics", name)
    for name in ("contact", "contact_vru", "contact_object", "off_road", "progress")
]


def make_env(batch=2, settings=None, **scene):
    return DrivingEnv(
        make_scenes(**{"num_scenes": 3} | scene), settings or SimSettings(), batch
    )


def act(env, acceleration=0.0, yaw_rate=0.0):
    action = torch.tensor([acceleration, yaw_rate]).repeat(env.batch_size[0], 1)
    return env.step(TensorDict({"action": action}, env.batch_size))["next"]


def drive(
    env,
    steps,
    acceleration=0.0,
    yaw_rate=0.0,
):
    """The td after `steps` equal actions, or at the first step where all are done."""
    for _ in range(steps):
        td = act(env, acceleration, yaw_rate=yaw_rate)
        if td["done"].all():
            break
    return td


def ended(yaw_rate=0.0, **scene):
    """An environment of one scene, and the last td of driving straight on, or in a
    bend."""
    env = make_env(num_scenes=1, **scene)
    env.reset()
    return env, drive(env, 80, yaw_rate=yaw_rate)


def flags(td):
    """What is true of all environments: how they end, and the metrics."""
    names = {
        "terminated": "terminated",
        "truncated": "truncated",
        **{key[1]: key for key in METRIC_KEYS[:4]},
    }
    assert all(len(td[key].unique()) == 1 for key in names.values())
    return [name for name, key in names.items() if td[key].all()]


def test_specs():
    check_env_specs(make_env(), seed=0)
    check_env_specs(make_env(settings=SimSettings(replay_ego=True)), seed=0)
    check_env_specs(DrivingEnv(make_scenes(3), SimSettings(), 2, agents=True), seed=0)


def test_what_is_not_observed_drives_alike():
    """The observation takes no part in what happens; an environment without it has
    none."""
    scenes = make_scenes(3)
    records, blind = (
        DrivingEnv(scenes, SimSettings(), 2, observed=observed)
        for observed in (True, False)
    )
    check_env_specs(DrivingEnv(scenes, SimSettings(), 2, observed=False), seed=0)
    begin = TensorDict({"scene_index": torch.tensor([[0], [2]])}, batch_size=[2])
    first = records.reset(begin.clone())
    other = blind.reset(begin.clone())
    for _ in range(15):
        action = torch.tensor([[1.0, 0.1], [-1.0, 0.2]])
        first, other = (
            env.step(td.set("action", action))["next"]
            for env, td in ((records, first), (blind, other))
        )
        assert other["observation"].shape == (2, 0)
        for key in (
            "reward",
            "done",
            ("metrics", "off_road"),
            ("metrics", "contact"),
            ("metrics", "progress"),
        ):
            assert torch.equal(first[key], other[key]), key


def test_the_reported_agents_are_the_environments_world():
    """A policy that reads the TensorDict sees the same moment as who asks the
    environment."""
    env = DrivingEnv(make_scenes(3), SimSettings(), 2, agents=True)
    env.reset()
    message = World.of(
        act(
            env,
            acceleration=1.0,
            yaw_rate=0.2,
        ),
        env.scene,
    )
    current = env.world()
    for name in ("step", "states", "valid", "accel", "turn_rate"):
        assert torch.equal(getattr(message, name), getattr(current, name)), name
    assert torch.allclose(message.turn_rate[:, 0], torch.tensor(0.2), atol=1e-4)


def test_partial_resets_keep_the_others_running():
    """next.timestep is timestep + 1 at every transition, and a trajectory never changes
    its scene."""
    env = make_env(
        batch=8,
        num_vehicles=4,
        num_scenes=5,
    )
    env.set_seed(0)
    torch.manual_seed(0)
    data = env.rollout(200, break_when_any_done=False)
    assert (data["next", "timestep"] == data["timestep"] + 1).all()
    assert (data["next", "scene_index"] == data["scene_index"]).all()
    finished = data["next", "done"][:, :-1]
    assert finished.any(1).all()
    assert (data["timestep"][:, 1:][finished] == 0).all()
    same = data["scene_index"][:, 1:] == data["scene_index"][:, :-1]
    assert same[~finished].all()
    assert not same[finished].all()
    carried = (data["next", "observation"][:, :-1] == data["observation"][:, 1:]).all(
        -1, keepdim=True
    )
    assert carried[~finished].all()
    assert not carried[finished].any()


def test_seed_makes_batches_identical():
    def batch():
        torch.manual_seed(7)
        env = make_env(
            batch=4,
            num_scenes=6,
        )
        env.set_seed(3)
        return env.rollout(
            20,
            lambda td: td.set("action", 3 * torch.randn(4, 2)),
            break_when_any_done=False,
        )

    first = batch()
    second = batch()
    assert (first["scene_index"] == second["scene_index"]).all()
    assert torch.equal(first["next", "observation"], second["next", "observation"])


def test_traffic_of_wrong_shape_or_nan_is_refused():
    env = make_env()
    scene = env.scenes.batch([0])
    with pytest.raises(InputError, match="expected"):
        env.set_traffic(
            torch.tensor([0]), scene["logged"][:, 1:], scene["logged_valid"][:, 1:]
        )
    with pytest.raises(InputError, match="NaN"):
        env.set_traffic(
            torch.tensor([0]), scene["logged"] * torch.nan, scene["logged_valid"]
        )


def test_written_traffic_is_executed():
    env = make_env()
    env.reset()
    act(env)
    before = env.world()
    vehicles = before.scene["route_log"].shape[1]
    future = before.states[:, :vehicles, None].repeat(1, 1, 50, 1)
    future[..., 1] += DT * torch.arange(1, 51)
    future[..., 3] = 5.0
    present = before.valid[:, :vehicles, None].repeat(1, 1, 50)
    present[:, 2, 1:] = False
    env.write_traffic(torch.arange(2), future, present)
    act(env)
    act(env)
    world = env.world()
    assert torch.allclose(world.states[:, 1:vehicles], future[:, 1:, 1])
    assert not world.valid[:, 2].any()
    assert world.valid[:, 1].all(), "a vehicle whose traffic turns invalid is gone"
    assert torch.allclose(
        world.states[:, vehicles:], world.scene["logged"][:, 3, vehicles:]
    )


def test_turn_rates_of_traffic_and_ego():
    """Everybody's heading difference over the last step; at the start the estimate of
    the recording."""
    scenes = make_scenes(1, num_vehicles=3)
    scenes.scenes["start_yaw_rate"][0, 1] = 0.3
    scenes.scenes["logged"][0, :, 2, 2] = 3.1 + 0.02 * torch.arange(81)
    env = DrivingEnv(scenes, SimSettings(), 1)
    env.reset()
    assert torch.allclose(env.world().turn_rate[0, :3], torch.tensor([0.0, 0.3, 0.0]))
    act(env, yaw_rate=-0.1)
    assert torch.allclose(
        env.world().turn_rate[0, :3], torch.tensor([-0.1, 0.0, 0.2]), atol=1e-4
    )


def test_running_into_a_parked_car_terminates_at_the_first_overlap():
    _, td = ended(vehicles=[(0.0, 0, 10.0), (30.0, 0, 0.0)])
    assert flags(td) == ["terminated", "contact"]
    front = td["timestep"] * DT * 10.0 + 4.5
    assert ((front > 30.0) & (front < 31.0 + 1e-3)).all()
    assert (td["reward"] < -5).all()


def test_leaving_the_road_terminates():
    _, td = ended(
        num_vehicles=1,
        num_vrus=0,
        yaw_rate=-0.3,
    )
    assert flags(td) == ["terminated", "off_road"]


def test_an_ego_that_begins_off_the_road_leaves_it_only_once_it_was_there():
    """The border comes back to it after 20 m, and ends behind it after 40 m more."""
    env = make_env(
        num_scenes=1,
        num_vehicles=1,
        num_vrus=0,
    )
    field = env.scenes.scenes["field"]
    x = env.scenes.scenes["field_origin"][0, 0] + torch.arange(field.shape[1])
    field[:] = torch.where((x > 20) & (x < 60), -2.0, 2.0)[None, :, None].to(
        field.dtype
    )
    env.reset()
    off = [bool(act(env)["metrics", "off_road"].any()) for _ in range(62)]
    assert not any(off[:59])
    assert any(off[59:])


def test_pedestrian_contact_is_its_own_metric():
    env = make_env(
        num_scenes=1,
        num_vehicles=1,
        settings=SimSettings(end_off_road=False),
    )
    env.scenes.scenes["logged"][:, :, 32, 1] = 0.0
    env.reset()
    assert flags(drive(env, 80)) == ["terminated", "contact_vru"]


def test_contact_with_an_object_is_its_own_metric():
    env = make_env(
        num_scenes=1,
        num_vehicles=1,
        settings=SimSettings(end_off_road=False),
    )
    env.scenes.scenes["logged"][:, :, 32, 1] = 0.0
    env.scenes.scenes["agent_type"][:, 32] = OTHER
    env.reset()
    assert flags(drive(env, 80)) == ["terminated", "contact_object"]


@pytest.mark.parametrize("apart", [False, True])
def test_who_appears_within_the_ego_touches_it_once_they_have_been_apart(apart):
    """A pedestrian appears at step 20 where the ego is, goes along with it, and stays
    there or is aside for a step."""
    env = make_env(
        batch=1,
        num_scenes=1,
        num_vehicles=1,
        settings=SimSettings(end_off_road=False),
    )
    scene = env.scenes.scenes
    scene["logged"][:, :, 32] = scene["logged"][:, :, 0]
    scene["logged_valid"][:, :20, 32] = scene["valid"][:, 32] = False
    scene["logged_valid"][:, 20:, 32] = True
    if apart:
        scene["logged"][:, 40, 32, 1] += 30.0
    env.reset()
    touched = [
        step for step in range(1, 81) if act(env)["metrics", "contact_vru"].any()
    ]
    assert touched == (list(range(41, 81)) if apart else [])


def test_map_end_truncates():
    env, td = ended(
        num_vehicles=1,
        road=(-60.0, 40.0),
    )
    assert flags(td) == ["truncated"]
    assert 38 <= td["metrics", "progress"].mean() <= 41
    assert not env.world().valid[:, 0].any()


def test_an_episode_goes_on_beyond_the_map_where_the_settings_say_so():
    """Evaluation records whole episodes, whatever becomes of the ego."""
    env = make_env(
        num_scenes=1,
        num_vehicles=1,
        road=(-60.0, 40.0),
        settings=SimSettings(end_when_gone=False),
    )
    env.reset()
    assert drive(env, 79)["done"].sum() == 0
    assert not env.world().valid[:, 0].any()
    assert act(env)["truncated"].all()


def test_replayed_ego_follows_its_log_and_progress_is_its_way():
    env = make_env(
        num_scenes=1,
        num_vehicles=2,
        settings=SimSettings(replay_ego=True),
    )
    env.reset()
    td = drive(env, 80, acceleration=-8.0)
    assert torch.allclose(
        env.world().states[:, 0], env.scene["logged"][:, 80, 0], atol=1e-4
    )
    assert torch.allclose(td["metrics", "progress"], torch.tensor(80.0), atol=1e-3)


def test_lonely_ego_and_no_lights():
    """N = 1: nobody else, padded or not."""
    scenes = make_scenes(
        1,
        num_vehicles=1,
        num_vrus=0,
        max_vehicles=1,
        max_agents=1,
    )
    scenes.scenes["light_state"] = scenes.scenes["light_state"][..., :0]
    env = DrivingEnv(scenes, SimSettings(), 2)
    check_env_specs(env)
    env.reset()
    assert torch.isfinite(drive(env, 80)["observation"]).all()


# --- held actions

# What may end an episode on the way: 80 is no multiple of 3, contact and border come
# between decisions.
WAYS = {
    "horizon": {"num_scenes": 3, "num_vehicles": 1, "num_vrus": 0},
    "contact": {"num_scenes": 3, "vehicles": [(0.0, 0, 10.0), (30.0, 0, 0.0)]},
    "map end": {"num_scenes": 3, "num_vehicles": 1, "road": (-60.0, 40.0)},
    "off road": {"num_scenes": 3, "num_vehicles": 1, "num_vrus": 0},
}


@pytest.mark.parametrize("hold", [2, 3])
@pytest.mark.parametrize("way", WAYS)
def test_a_held_action_is_that_action_at_every_step_until_the_episode_ends(way, hold):
    """Against an environment without holding: rewards add up, flags of any moment
    count, nobody runs on."""
    once, held = (
        DrivingEnv(make_scenes(**WAYS[way]), SimSettings(), 4, hold=steps)
        for steps in (1, hold)
    )
    index = TensorDict({"scene_index": torch.tensor([[0], [1], [2], [0]])}, [4])
    assert torch.equal(
        once.reset(index.clone())["observation"],
        held.reset(index.clone())["observation"],
    )
    action = torch.tensor([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [3.0, 0.0]])
    action[:, 1] = -0.2 if way == "off road" else 0.0
    alive = torch.ones(4, dtype=torch.bool)
    rewards = []
    last = None
    while alive.any():
        expected = None
        reward = torch.zeros(4, 1)
        for _ in range(hold):
            current = once.step(TensorDict({"action": action}, [4]))["next"]
            reward = reward + current["reward"] * alive[:, None]
            expected = (
                current.clone()
                if expected is None
                else torch.where(alive, current, expected)
            )
            alive = alive & ~current["done"][:, 0]
        result = held.step(TensorDict({"action": action}, [4]))["next"]
        running = torch.ones(4, dtype=torch.bool) if last is None else ~last
        for key in (
            "observation",
            "timestep",
            "done",
            "terminated",
            "truncated",
            *METRIC_KEYS,
        ):
            assert torch.equal(result[key][running], expected[key][running]), key
        torch.testing.assert_close(result["reward"][running], reward[running])
        last = result["done"][:, 0] if last is None else last | result["done"][:, 0]
        rewards.append(reward)
    assert last.all()


def test_what_a_reset_of_some_writes_is_what_a_reset_of_all_writes():
    whole, some = (
        make_env(
            batch=4,
            num_vehicles=6,
            num_scenes=5,
        )
        for _ in range(2)
    )
    index = torch.tensor([[4], [1], [3], [0]])
    observed = whole.reset(TensorDict({"scene_index": index}, [4]))["observation"]
    some.reset(TensorDict({"scene_index": torch.tensor([[0], [1], [2], [0]])}, [4]))
    start = torch.tensor([[True], [False], [True], [False]])
    seen_anew = some.reset(TensorDict({"scene_index": index, "_reset": start}, [4]))[
        "observation"
    ]
    torch.testing.assert_close(seen_anew[start[:, 0]], observed[start[:, 0]])
    assert torch.equal(
        act(whole, 1.0, yaw_rate=0.1)["observation"],
        act(some, 1.0, yaw_rate=0.1)["observation"],
    )
