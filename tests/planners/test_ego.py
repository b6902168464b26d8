"""Tracking leaves no error on drivable plans, makes good deviations, and a policy
restarts with its episodes."""

from dataclasses import replace

import pytest
import torch

from e2rl.planners.bits import BitsEgo
from e2rl.planners.ego import PLAN_STEPS, Ego, return_length, track
from e2rl.planners.ego_errors import Undrivable
from e2rl.planners.ego_policy import EgoPolicy
from e2rl.planners.idm_planner import IDMEgo
from e2rl.planners.lane_graph_planner import LaneGraphEgo
from e2rl.planners.log_replay import ReplayEgo
from e2rl.planners.path import MissionPath
from e2rl.planners.sampling import SamplingEgo
from e2rl.prior.lane_relative import HORIZON
from e2rl.run.config import built, load_choice
from e2rl.run.errors import InputError
from e2rl.scenes.recording import LIGHT_GREEN
from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv
from e2rl.sim.settings import SimSettings
from e2rl.traffic.lookahead import Lookahead
from e2rl.traffic.rollout import roll_out
from e2rl.traffic.rule_based import ConstantVelocity, LogReplay
from tests.planners.planners import all_driven, driven, world_of, worlds
from tests.synthetic import make_scenes


class Cruise(Ego):
    """Holds its speed along its mission."""

    def plan(self, world):
        return MissionPath(world).drive(
            world.states[:, 0, 3:].expand(-1, PLAN_STEPS + 1)
        )


def test_a_drivable_plan_is_followed_without_error():
    generator = torch.Generator().manual_seed(0)
    start = torch.tensor([0.0, 0.0, 0.5, 12.0], dtype=torch.float64)
    actions = torch.randn(
        50,
        2,
        generator=generator,
        dtype=torch.float64,
    ) * torch.tensor([2.0, 0.2])
    plan = torch.cat([start[None], dynamics.rollout(start, actions)])
    state = start
    for k in range(50):
        state = dynamics.step(state, track(state, plan[k], following=plan[k + 1]))
        assert torch.allclose(state[:2], plan[k + 1, :2], atol=1e-6)


def test_deviations_are_made_good():
    distance = torch.arange(0, 60.0)
    plan = torch.stack([distance, 0 * distance, 0 * distance, 10 + 0 * distance], -1)
    state = torch.tensor([-0.8, 1.0, 0.1, 9.0])
    for k in range(50):
        state = dynamics.step(state, track(state, plan[k], following=plan[k + 1]))
    assert (state - plan[50])[:2].abs().max() < 0.05
    assert state[2].abs() < 0.02


def test_a_lateral_error_fades_over_0_7_seconds_and_1_5_metres_at_least():
    lengths = return_length(torch.tensor([0.0, 2.0, 10.0]))
    torch.testing.assert_close(lengths, torch.tensor([1.5, 1.5, 7.0]))


def test_a_metre_behind_its_plan_the_ego_drives_a_metre_a_second_faster():
    state = torch.tensor([0.0, 0.0, 0.0, 10.0])
    planned = torch.tensor([1.0, 0.0, 0.0, 10.0])
    following = torch.tensor([2.0, 0.0, 0.0, 10.0])
    action = track(state, planned, following=following)
    torch.testing.assert_close(action, torch.tensor([10.0, 0.0]))


def make_env(scenes, batch):
    return DrivingEnv(scenes, SimSettings(), batch, agents=True)


@pytest.mark.parametrize(("kind", "atol"), [(Cruise, 1e-3), (IDMEgo, 0.05)])
def test_what_a_policy_writes_as_its_plan_is_what_it_then_drives(kind, atol):
    """It plans once in each interval; in between, its plan is the rest of the last one."""
    env = make_env(
        make_scenes(
            2,
            num_vehicles=1,
            limit=12.0,
        ),
        2,
    )
    ego = kind(replan_every=5)
    product = []
    plan = ego.plan
    ego.plan = lambda world: product.append(plan(world)) or product[-1]
    data = env.rollout(30, EgoPolicy(ego, env))
    message = data["ego", "plan"]
    driven = data["next", "agents", "states"][:, :, 0]
    assert len(product) == 6
    assert message.shape[2] == PLAN_STEPS
    for step in range(30):
        fresh = product[step // 5]
        age = step % 5
        assert torch.equal(message[:, step, : PLAN_STEPS - age], fresh[:, age:])
        assert torch.equal(
            message[:, step, PLAN_STEPS - age :], fresh[:, -1:].expand(-1, age, -1)
        ), "its end is held"
    assert torch.allclose(driven, message[:, :, 0], atol=atol)
    for step in range(0, 30, 5):
        assert torch.allclose(
            driven[:, step : step + 5], message[:, step, :5], atol=atol
        ), "the interval that follows"


def test_a_reset_in_between_makes_a_new_plan_there():
    """Environment 0 hits a wall early and starts anew while 1 drives on: both stay on
    their lanes' centre."""
    scenes = make_scenes(2, vehicles=[(0.0, 0, 10.0), (23.0, 0, 0.0)])
    scenes.scenes["valid"][1, 1] = False
    scenes.scenes["logged_valid"][1, :, 1] = False
    env = make_env(scenes, 4)
    env.set_seed(1)
    data = env.rollout(
        70, EgoPolicy(Cruise(replan_every=5), env), break_when_any_done=False
    )
    finished = data["next", "done"]
    assert finished.any()
    assert not finished.all(0).any()
    assert data["action"].abs().max() < 1e-3


class Planned(Ego):
    """What a function of the World returns as its plans."""

    def __init__(self, of):
        super().__init__(5)
        self.of = of

    def plan(self, world):
        return self.of(keep(world))


def keep(world):
    ahead = 0.1 * torch.arange(1, PLAN_STEPS + 1)
    return dynamics.constant_velocity(world.states[:, 0], ahead)


def drive(ego, scenes, steps=12):
    env = make_env(scenes, len(scenes))
    return env.rollout(steps, EgoPolicy(ego, env), break_when_any_done=False)


@pytest.mark.parametrize(
    ("of", "told"),
    [
        (
            lambda plan: plan[:, :30],
            r"Planned.plan: returns torch.float32 \[2, 30, 4\], .*floats \[2, 50, 4\]",
        ),
        (lambda plan: plan[0], r"\[50, 4\], expected a tensor of floats \[2, 50, 4\]"),
        (
            lambda plan: plan.numpy(),
            r"returns ndarray of float32 \[2, 50, 4\], of which torch.as_tensor",
        ),
        (lambda plan: plan.long(), "torch.int64"),
        (lambda plan: None, "NoneType"),
    ],
)
def test_plans_of_another_shape_or_type_are_told_so(of, told):
    with pytest.raises(InputError, match=told):
        drive(Planned(of), make_scenes(2))


@pytest.mark.parametrize(
    "of",
    [
        lambda plan: 0 * plan,
        lambda plan: plan - plan[:, :1],  # in the frame of the ego
        lambda plan: plan + torch.tensor([0.0, 0, torch.pi / 2, 0]),
        lambda plan: plan + torch.tensor([2.5, 0, 0, 0]),  # of another time
    ],
)
def test_a_plan_that_begins_elsewhere_ends_its_rollout(of):
    with pytest.raises(
        Undrivable, match="begins more than 2 m ahead of, behind, 5 m beside or 1 rad"
    ) as refused:
        drive(Planned(of), make_scenes(2, vehicles=[(3.5, 0, 10.0)]))
    assert set(refused.value.rows) == {0, 1}
    drive(
        Planned(lambda plan: plan + torch.tensor([0.5, 3.0, 0.1, 0])),
        make_scenes(2),
        steps=8,
    )  # on the lane beside


def reversing(plan):
    """Back along x at 5 m/s from where the ego is."""
    ahead = 0.1 * torch.arange(1, PLAN_STEPS + 1)
    start = plan[:, :1, 0] - 0.1 * plan[:, :1, 3]
    return torch.stack(
        [
            start - 5 * ahead,
            *plan[..., 1:3].unbind(-1),
            torch.full_like(start - ahead, -5.0),
        ],
        -1,
    )


@pytest.mark.parametrize(
    ("signed", "speed"), [(True, 20.0), (False, 20.0), (True, 12.0)]
)
def test_a_plan_that_goes_backwards_is_told_that_egos_do_not_reverse(signed, speed):
    """Whether or not it says so by its speeds; at 12 m/s it begins less than 2 m from
    the ego, and asks for an action beyond all bounds."""
    planned = Planned(
        lambda plan: reversing(plan) * torch.tensor([1.0, 1, 1, 1 if signed else -1])
    )
    scenes = make_scenes(1, speed=speed)
    with pytest.raises(Undrivable, match="goes backwards: egos do not reverse"):
        drive(planned, scenes)


class Braking(Ego):
    """A policy: it has no plan."""

    def act(
        self,
        world,
        observation,
        plan,
    ):
        return torch.tensor([-2.0, 0.0]).expand(len(plan), 2)


def test_a_policy_overrides_act_alone():
    """It is announced to hold its velocity, and does what it acts."""
    steps = drive(Braking(), make_scenes(2, speed=10.0), 20)
    assert torch.allclose(
        steps["next", "agents", "states"][:, -1, 0, 3], torch.full((2,), 6.0), atol=1e-4
    )
    assert torch.allclose(
        steps["ego", "plan"][:, 0, :, 3], torch.full((2, PLAN_STEPS), 10.0)
    )


def test_replayed_log_is_tracked():
    env = make_env(make_scenes(1, num_vehicles=2), 1)
    env.rollout(80, EgoPolicy(ReplayEgo(), env))
    assert torch.allclose(
        env.world().states[:, 0], env.scene["logged"][:, 80, 0], atol=0.01
    )


@pytest.mark.parametrize(
    "name", ["idm", "lane_graph", "lane_graph_tuned", "replay", "sampling", "bits"]
)
def test_a_file_of_the_configuration_builds_its_ego(name):
    ego = built(load_choice("ego", name), "ego", kind=Ego)
    plan = ego.plan(world_of(num_scenes=2)[1])
    assert plan.shape == (2, PLAN_STEPS, 4)
    assert torch.isfinite(plan).all()
    with pytest.raises(InputError, match=r"ego\.replan_every=0"):
        type(ego)(replan_every=0)


class Straight(Ego):
    """Holds its speed and heading; acts itself."""

    def plan(self, world):
        return dynamics.constant_velocity(
            world.states[:, 0], 0.1 * torch.arange(1, PLAN_STEPS + 1)
        )

    def act(
        self,
        world,
        observation,
        plan,
    ):
        return super().act(world, observation, plan)


class Meddler(Straight):
    """Keeps what it is told as it plans, and overwrites whatever it is given."""

    def reset(self, world):
        self.told = []

    def plan(self, world):
        message = {
            **world.scene,
            **{name: value for name, value in vars(world).items() if name != "scene"},
        }
        self.told.append(
            {
                key: value if value is None else value.clone()
                for key, value in message.items()
            }
        )
        return self.meddle(super().plan(world), *message.values())

    def act(
        self,
        world,
        observation,
        plan,
    ):
        message = observation, plan, world.states, world.valid, *world.scene.values()
        return self.meddle(super().act(world, observation, plan), *message)

    def meddle(self, made, *told):
        for value in told:
            if (
                value is not None and not value.dtype.is_floating_point
            ):  # of the scene, the step, who is there
                value.zero_()
            elif value is not None:
                value.add_(7.0)
        return made


def test_code_from_outside_moves_nobody():
    scenes = make_scenes(
        2,
        num_vehicles=3,
        red_light_x=60.0,
    )
    data = [
        env.rollout(20, EgoPolicy(ego(), env))
        for ego in (Straight, Meddler)
        for env in [make_env(scenes, 2)]
    ]
    for key in ("observation", "agents", "action", "ego"):
        assert (data[0][key] == data[1][key]).all(), key


@pytest.mark.parametrize("traffic", [LogReplay(), ConstantVelocity()])
def test_two_recordings_with_one_present_tell_code_from_outside_the_same(traffic):
    """Everything that a planner is told, in rollouts and by traffic that asks it
    beforehand, is of the present."""
    first = make_scenes(
        2,
        num_vehicles=3,
        num_vrus=2,
        red_light_x=60.0,
        steps=40,
    )
    message = []
    first.scenes["valid"][:, 2] = first.scenes["logged_valid"][:, :, 2] = False
    second = replace(first, scenes=first.scenes.clone())
    later = {
        key: second.scenes[key][:, 12:]
        for key in ("logged", "logged_valid", "light_state")
    }
    later["logged"][..., :2] += 9.0
    later["logged_valid"].logical_not_(), later["light_state"].fill_(LIGHT_GREEN)
    second.scenes["route_log"][:, 1:] += 1
    second.scenes["size"][:, 2] = second.scenes["agent_type"][:, 2] = 3
    for scenes in (first, second):
        ego = Meddler()
        roll_out(
            scenes,
            torch.arange(2),
            seed=torch.arange(2),
            eta=torch.zeros(2),
            ego=ego,
            traffic=traffic,
            sim=SimSettings(),
        )
        message.append(ego.told[:3])  # at steps 0, 5 and 10
        ego.told = []
        world = worlds(scenes)[1]
        planned = world.states[:, :3, None].repeat(1, 1, HORIZON, 1)
        Lookahead(ego, replace(world, plan=planned))(torch.arange(2), planned)
        message[-1] += ego.told
    for single, other in zip(*message, strict=True):
        assert len(message[0]) == 8
        assert single.pop("plan") is single.pop("route") is None
        assert not [key for key in single if not torch.equal(single[key], other[key])]


def test_an_action_that_no_vehicle_can_take_is_refused_by_its_row():
    class Wild(Straight):
        def act(
            self,
            world,
            observation,
            plan,
        ):
            return torch.tensor([[1.0, 0.1], [1e30, 0.0]])

    env = make_env(make_scenes(2), 2)
    with pytest.raises(Undrivable) as caught:
        EgoPolicy(Wild(), env)(env.reset())
    assert list(caught.value.rows) == [1]


@pytest.mark.parametrize("kind", [IDMEgo, LaneGraphEgo, SamplingEgo, BitsEgo])
def test_a_planner_of_the_package_needs_no_future(kind):
    env, world = world_of(
        num_scenes=2,
        red_light_x=60.0,
    )
    env.rollout(7, EgoPolicy(kind(), env))
    assert torch.equal(kind().plan(env.world()), kind().plan(env.world().shown()))


@pytest.mark.parametrize("kind", [LaneGraphEgo, SamplingEgo, BitsEgo])
def test_scenes_of_a_batch_do_not_mix(kind):
    """Planned together, beyond a chunk, or alone, a scene gets the same plan."""
    ego = kind()
    count = 66 if kind is BitsEgo else 10
    scenes = make_scenes(
        count,
        vehicles=[(0.0, 0, 10.0), (22.0, 0, 6.0), (10.0, 1, 10.0), (-15.0, 0, 11.0)],
    )
    scenes.scenes["start"][1, 1:4, 0] += 6.0
    scenes.scenes["valid"][2, 1:] = False
    together = ego.plan(worlds(scenes)[1])
    for k in (0, 1, 2, count - 1):
        alone = ego.plan(worlds(scenes.chosen([k]))[1])[0]
        torch.testing.assert_close(
            alone,
            together[k],
            atol=1e-3,
            rtol=0,
        )
    assert not torch.allclose(together[1, :, 3], together[2, :, 3])


@pytest.mark.parametrize("kind", [IDMEgo, LaneGraphEgo, SamplingEgo, BitsEgo])
def test_a_red_light_is_halted_at_and_at_a_green_one_it_drives_on(kind):
    halts_by = (
        48.3 if kind is IDMEgo else 47.8
    )  # the line is at 50 m, the front 2.25 m ahead of the centre
    scenes = make_scenes(
        2,
        num_vehicles=1,
        num_vrus=0,
        red_light_x=50.0,
    )
    scenes.scenes["light_state"][1] = LIGHT_GREEN
    _, (red, green) = all_driven(kind(), scenes)
    assert 35.0 < red[0] < halts_by
    assert red[3] < 2.5
    assert green[0] > 55.0
    assert green[3] > 2.5


@pytest.mark.parametrize("kind", [LaneGraphEgo, SamplingEgo])
def test_a_free_road_is_driven_at_the_limit_and_behind_a_wall_it_halts(kind):
    scenes = make_scenes(
        3,
        vehicles=[(0.0, 0, 10.0), (50.0, 0, 0.0), (50.0, 1, 0.0)],
        num_vrus=0,
    )
    scenes.scenes["route_limit"][0] = 0.0  # unknown
    scenes.scenes["route_limit"][1] = 12.0
    for name in ("valid", "logged_valid"):
        scenes.scenes[name][:2, ..., 1:] = False  # alone
    data, (unknown, limited, behind_wall) = all_driven(kind(), scenes)
    assert not data["next", "terminated"].any()
    assert abs(unknown[3] - 20.0) < 0.3
    assert abs(limited[3] - 12.0) < 0.3
    assert data["next", "agents", "states"][:2, :, 0, 1].abs().max() < 0.05
    assert behind_wall[3] < 2.0
    assert 20 < behind_wall[0] < 46


def test_idm_settles_behind_a_slower_leader_and_returns_to_its_lane():
    data, state = driven(
        IDMEgo(),
        vehicles=[(0.0, 0, 9.0), (30.0, 0, 6.0), (30.0, 1, 0.0)],
        limit=10.0,
    )
    assert not data["next", "done"][:, :-1].any()
    assert state[3] < 7.0
    assert 8 < 30.0 + 8 * 6.0 - state[0] - 4.5 < 20
    scenes = make_scenes(1, num_vehicles=1)
    scenes.scenes["start"][0, 0, 1:3] = torch.tensor([0.8, -0.1])
    env = worlds(scenes)[0]
    assert env.rollout(60, EgoPolicy(IDMEgo(), env))["action"][..., 1].abs().max() < 0.3
    assert env.world().states[0, 0, 1].abs() < 0.03
