"""Vehicles that leave replayed traffic: who, from when on, what stays as it was, and that seeds decide."""

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from e2rl.planners.ego import EgoPolicy
from e2rl.planners.idm_planner import IDMEgo
from e2rl.run.errors import InputError
from e2rl.run.settings import settings_of
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.traffic.e2.reaiming import LATEST, ReactSettings, Reaiming
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.reaction import NewEpisodes
from e2rl.traffic.transform import AdversarialSynthesizer
from tests.traffic.e2.traffic_scenes import ROWS, scenes
from tests.traffic.test_transform import March, in_turn

ON = SimSettings(end_on_contact=False, end_off_road=False)
EVERYBODY = ReactSettings(share=1.0, others=0.0)
STEPS = 40


def stored(scene_set, eta=2.0):
    """Stored rows that replay the log, with vehicles 2 and 3 as adversaries."""
    scene, index = scene_set.scenes, torch.arange(len(scene_set))
    adversaries = torch.zeros(scene["logged_valid"][:, 0].shape, dtype=torch.bool)
    adversaries[:, 2:4] = True
    traffic = {"scene_index": index, "states": scene["logged"], "valid": scene["logged_valid"]}
    return TrafficPool.stored(traffic | {"adversaries": adversaries}, eta)


def driven(pool, scene_set, settings, seed=0, traffic=None, policy=None, steps=STEPS):
    """Frames [B, T] of an ego in each row of a pool."""
    base = DrivingEnv(scene_set, ON, len(pool), agents=True)
    reaction = None if settings is None else Reaiming(settings, seed)
    env = TransformedEnv(base, AdversarialSynthesizer(pool, in_turn(pool), traffic, reaction=reaction))
    return env.rollout(steps, policy or EgoPolicy(IDMEgo(), env), break_when_any_done=False)


def tracks(frames):
    return frames["next", "agents", "states"]


@pytest.fixture(scope="module")
def scene_set():
    return scenes(4, STEPS)


def test_traffic_in_which_nobody_reacts_is_today_s_bit_for_bit(scene_set):
    pool = stored(scene_set) + stored(scene_set, 0.0) + TrafficPool.recorded(torch.arange(4))
    today = driven(pool, scene_set, None)
    nobody = driven(pool, scene_set, ReactSettings(share=0.0))
    for key in today.keys(True, True):
        assert torch.equal(today[key], nobody[key]), key
    reacting = driven(pool, scene_set, EVERYBODY)
    assert torch.equal(tracks(today)[4:], tracks(reacting)[4:]), "nor in rows without an intensity"


def test_rows_of_live_traffic_never_react(scene_set):
    pool = TrafficPool.live(torch.arange(4), torch.full((4,), 2.0), torch.arange(4)) + stored(scene_set)
    alone, beside = (driven(pool, scene_set, settings, traffic=March()) for settings in (None, EVERYBODY))
    assert torch.equal(tracks(alone)[:4], tracks(beside)[:4])
    assert not torch.equal(tracks(alone)[4:], tracks(beside)[4:])


def test_the_row_s_adversaries_leave_the_replay_and_everybody_else_stays(scene_set):
    pool = stored(scene_set)
    frames = driven(pool, scene_set, EVERYBODY)
    moved = (tracks(frames) != pool.parts[0].states[:, 1:]).any(-1)
    others = [1, *range(4, moved.shape[2])]
    assert moved[:, :, 2:4].any(2).any(1).all() and not moved[:, :, others].any()
    marked = frames["next", "traffic", "adversary"]
    assert marked[..., 2:4].all() and not marked[..., [0, 1, *range(4, ROWS)]].any()
    first = moved[:, :, 2:4].any(2).int().argmax(1)
    assert (first <= LATEST * STEPS + 5).all() and len(first.unique()) > 1, "at random moments"


def test_other_vehicles_that_move_near_the_ego_react_and_are_marked(scene_set):
    pool = stored(scene_set)
    frames = driven(pool, scene_set, ReactSettings(share=1.0, others=1.0, responsibility="none"))
    moved = (tracks(frames) != pool.parts[0].states[:, 1:]).any(-1)
    marked = frames["next", "traffic", "adversary"]
    assert moved[:, :, [1, 4]].any(2).any(1).all() and not moved[:, :, [2, 3, 5]].any(), "5 is parked"
    assert torch.equal(marked[..., [1, 4]].any(1), moved[..., [1, 4]].any(1))
    full = driven(pool, scene_set, ReactSettings(share=1.0, others=1.0))
    leads = (tracks(full) != pool.parts[0].states[:, 1:]).any(-1)[..., 4]
    assert not leads.any(), "under full responsibility none that leads the ego's way"


def test_motions_are_smooth_and_never_backwards(scene_set):
    pool = stored(scene_set)
    states = tracks(driven(pool, scene_set, EVERYBODY, seed=3))[:, :, 2:4]
    way = (states[:, 1:, :, :2] - states[:, :-1, :, :2]).norm(dim=-1)
    mean = (states[:, 1:, :, 3] + states[:, :-1, :, 3]) / 2
    assert (states[..., 3] >= 0).all()
    torch.testing.assert_close(way, 0.1 * mean, rtol=0, atol=0.01)
    assert (states[..., 3].diff(dim=1).abs() <= 0.1 * 7.0 + 1e-3).all(), "within the bounds of braking"


def test_the_seed_decides(scene_set):
    pool = stored(scene_set)
    first, again, other = (tracks(driven(pool, scene_set, EVERYBODY, seed)) for seed in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_an_announced_plan_changes_nothing(scene_set):
    pool = stored(scene_set)

    def policy(lie):
        def act(tensordict):
            tensordict["action"] = torch.tensor([0.3, 0.0]).repeat(len(tensordict), 1)
            tensordict["ego", "plan"] = torch.full((len(tensordict), 50, 4), lie)
            return tensordict

        return act

    one, two = (driven(pool, scene_set, EVERYBODY, policy=policy(lie)) for lie in (0.0, 99.0))
    assert torch.equal(tracks(one), tracks(two))


def test_new_episodes_draw_anew_and_others_go_on(scene_set):
    pool = stored(scene_set)
    reaction = Reaiming(EVERYBODY)
    env = TransformedEnv(
        DrivingEnv(scene_set, ON, 4, agents=True), AdversarialSynthesizer(pool, in_turn(pool), reaction=reaction)
    )
    tensordict, policy = env.reset(), EgoPolicy(IDMEgo(), env)
    for _ in range(STEPS - 5):
        tensordict = env.step(policy(tensordict))["next"]
    before = reaction.acting
    assert before.any(1).all()
    second = torch.tensor([[False], [True], [False], [False]])
    tensordict = env.reset(tensordict.set("_reset", second))
    assert not reaction.acting[1].any() and torch.equal(reaction.acting[[0, 2, 3]], before[[0, 2, 3]])
    assert torch.equal(tensordict["agents", "states"][1], scene_set.scenes["start"][tensordict["scene_index"][1, 0]])


def test_the_specs_hold(scene_set):
    pool = stored(scene_set)
    base = DrivingEnv(scene_set, ON, 4, agents=True)
    check_env_specs(TransformedEnv(base, AdversarialSynthesizer(pool, in_turn(pool), reaction=Reaiming(EVERYBODY))))


def test_shares_of_episodes_are_as_set():
    count = 4000
    reaction = Reaiming(ReactSettings(share=0.6, others=0.3, eta=(1.0, 3.0), reckless=0.2))
    some = torch.arange(count) % 4 > 0
    reaction.begin(NewEpisodes(torch.arange(count), some, torch.zeros(count, 5, dtype=torch.bool), count, 80))
    part = reaction._part
    reacts = part["start"] < 80
    assert not reacts[~some].any() and reacts[some].float().mean() == pytest.approx(0.6, abs=0.03)
    assert part["others"].float().mean() == pytest.approx(0.3, abs=0.03)
    assert part["eta"].min() >= 1 and part["eta"].max() <= 3 and part["eta"].mean() == pytest.approx(2, abs=0.05)
    assert part["reckless"].float().mean() == pytest.approx(0.2, abs=0.03)
    assert part["count"].unique().tolist() == [1, 2]


@pytest.mark.parametrize(
    "wrong",
    [
        {"share": 1.2},
        {"others": -0.1},
        {"reckless": 2},
        {"scatter": -1},
        {"eta": [3.0, 1.0]},
        {"responsibility": "some"},
    ],
)
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        settings_of(ReactSettings, wrong, "learner.react")
