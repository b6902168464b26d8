"""The transform: episodes are the rows drawn, live traffic is what its method plans,
resets are partial."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, ParallelEnv, RewardSum, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from e2rl.planners.ego import Ego
from e2rl.planners.ego_errors import PlannerError, TrafficNotFinite
from e2rl.planners.ego_policy import EgoPolicy
from e2rl.planners.idm_planner import IDMEgo
from e2rl.run.errors import InputError
from e2rl.sim.env import DrivingEnv
from e2rl.sim.settings import SimSettings
from e2rl.traffic.attempt import attempt
from e2rl.traffic.pool import RowDraw, TrafficPool
from e2rl.traffic.traffic import Traffic, TrafficPlan, keep_velocity
from e2rl.traffic.transform import AdversarialSynthesizer
from tests.learning.small import brake_check
from tests.traffic.e2.traffic_scenes import EGO, ROWS, scenes, synthesizer

ON = SimSettings(end_on_contact=False, end_off_road=False)
SECOND = torch.tensor([[False], [True], [False]])  # environments that are reset


class March(Traffic):
    """Everybody goes straight on at a speed that tells the seed and the replan: seed +
    replan / 10, in m/s."""

    def __init__(self):
        self.calls = []

    def reset(self, scenes, seed, eta):
        return torch.stack([seed.float(), torch.zeros_like(eta)], 1)

    def replan(self, state, world, ego_plan):
        self.calls.append((world.step.tolist(), ego_plan))
        states = world.states[:, : world.scene["route_log"].shape[1]].clone()
        states[..., 3] = (state[:, 0] + state[:, 1] / 10)[:, None]
        states = keep_velocity(states)
        acting = torch.zeros(states.shape[:2], dtype=torch.bool)
        acting[:, 1] = True
        here = world.valid[:, : acting.shape[1], None].expand(states.shape[:-1])
        return state + torch.tensor([0.0, 1.0]), TrafficPlan(
            states, here, adversary=acting
        )


def in_turn(pool):
    """Rows of a pool one after another, from the start again after its end."""
    drawn = [0]

    def draw(count):
        drawn[0] += count
        return torch.arange(drawn[0] - count, drawn[0]) % len(pool)

    return draw


def environment(pool, traffic=None, steps=20, batch=3, scene_set=None, ego=None):
    base = DrivingEnv(scene_set or scenes(3, steps), ON, batch, agents=True)
    return TransformedEnv(
        base, AdversarialSynthesizer(pool, in_turn(pool), traffic=traffic, ego=ego)
    )


def live(eta=0.0, count=9):
    """Rows of scenes 0, 1, 2, 0, ... whose seed is the row."""
    row = torch.arange(count)
    return TrafficPool.live(row % 3, torch.full((count,), eta), seed=row)


def replayed(scene_set, eta=4.0):
    """Stored rows of all scenes, then recorded ones."""
    index = torch.arange(len(scene_set))
    return TrafficPool.stored(
        brake_check(scene_set)(None, index, eta, 0), eta
    ) + TrafficPool.recorded(index)


def mixed(scene_set, eta=1.0):
    return live(eta, len(scene_set)) + replayed(scene_set)


def advance(env, policy, tensordict, steps):
    for _ in range(steps):
        tensordict = env.step(policy(tensordict))["next"]
    return tensordict


def still(tensordict):
    """A policy that says nothing about its plan."""
    return tensordict.set("action", torch.zeros(len(tensordict), 2))


@pytest.mark.parametrize(
    "traffic", [None, March(), synthesizer()], ids=["none", "march", "e2"]
)
def test_the_specs_hold(traffic):
    scene_set = scenes(3)
    pool = replayed(scene_set) if traffic is None else mixed(scene_set)
    check_env_specs(environment(pool, traffic, batch=6, scene_set=scene_set), seed=0)


# --- seeds


def random_environment(own=0, traffic=None):
    """Draws by a generator of their own, which begins with seed `own`."""
    scene_set = scenes(3, 10)
    pool = replayed(scene_set) if traffic is None else mixed(scene_set)
    draw = RowDraw(torch.ones(len(pool)).double(), own)
    base = DrivingEnv(scene_set, ON, 4, agents=True)
    return TransformedEnv(
        base,
        Compose(
            AdversarialSynthesizer(pool, draw, traffic=traffic),
            RewardSum(),
        ),
    )


def same(first, second):
    """What episodes are, bit for bit."""
    keys = sorted(first.keys(True, True), key=str)
    assert keys == sorted(second.keys(True, True), key=str)
    assert ("next", "agents", "states") in keys
    return all(torch.equal(first[key], second[key]) for key in keys)


@pytest.mark.parametrize("traffic", [None, March()], ids=["replay", "live"])
def test_a_seed_decides_the_episodes(traffic):
    """Of two environments alike, and of one that has driven already."""

    def episodes(env, seed):
        env.set_seed(seed)
        return env.rollout(25, still, break_when_any_done=False)

    first = random_environment(0, traffic)
    second = random_environment(1, traffic)
    once = episodes(first, 3)
    assert same(once, episodes(second, 3))
    assert same(once, episodes(first, 3))
    assert not torch.equal(once["traffic", "row"], episodes(first, 4)["traffic", "row"])


def collected(kind, own, seed):
    """The first batch of a collector, of one environment or of two in `kind`."""
    env = (
        random_environment(own)
        if kind is None
        else kind(2, random_environment, create_env_kwargs={"own": own})
    )
    collector = Collector(
        env,
        frames_per_batch=160,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    torch.manual_seed(0)  # of the random actions
    collector.set_seed(seed)
    collector.reset()  # it has begun episodes when it was made
    batch = next(iter(collector)).clone()
    collector.shutdown()
    return batch


@pytest.mark.parametrize("kind", [None, SerialEnv])
def test_a_seed_decides_what_a_collector_collects(kind):
    once = collected(kind, 0, seed=3)
    assert same(once, collected(kind, 1, seed=3))
    assert not torch.equal(
        once["traffic", "row"], collected(kind, 0, seed=4)["traffic", "row"]
    )


@pytest.mark.slow
def test_a_seed_decides_the_episodes_of_processes():
    assert same(collected(ParallelEnv, 0, seed=3), collected(SerialEnv, 1, seed=3))


# --- live rows


def test_a_partial_reset_begins_those_rows_anew_and_leaves_the_others():
    on = March()
    env = environment(live(), on)
    policy = EgoPolicy(IDMEgo(), env)
    tensordict = advance(env, policy, tensordict=env.reset(), steps=7)
    tensordict = env.reset(tensordict.set("_reset", SECOND))
    assert tensordict["scene_index"][:, 0].tolist() == [0, 0, 2]
    assert tensordict["timestep"][:, 0].tolist() == [7, 0, 7]
    assert tensordict["traffic", "row"][:, 0].tolist() == [0, 3, 2]
    tensordict = advance(env, policy, tensordict=tensordict, steps=4)
    assert [steps for steps, _ in on.calls] == [[0, 0, 0], [5, 5, 5], [0], [10, 10]]
    speed = tensordict["agents", "states"][:, 1, 3]
    torch.testing.assert_close(
        speed, torch.tensor([0.2, 3.0, 2.2])
    )  # by seed, and replans of its own


def test_a_method_that_asks_the_ego_can_where_there_is_one():
    requests = []

    class Asking(March):
        queries_ego = True

        def replan(self, state, world, ego_plan, react=None):
            requests.append(
                react
                and react(
                    torch.tensor([1]), keep_velocity(world.states[1:2, :ROWS])
                ).shape
            )
            return super().replan(state, world, ego_plan)

    for ego in (EGO, None):
        env = environment(live(), Asking(), ego=ego)
        advance(env, still, tensordict=env.reset(), steps=1)
    assert requests == [(1, 50, 4), None]


class Picky(Ego):
    """Has no plan for an ego beyond 100 m at the present, nor where a vehicle is NaN."""

    def plan(self, world):
        if not bool(world.states.isfinite().all()):
            raise ValueError("NaN")
        lacking = (
            ((world.states[:, 0, 0] > 100) & (world.step <= 1)).nonzero()[:, 0].tolist()
        )
        if lacking:
            raise PlannerError("no plan", dict.fromkeys(lacking, "no plan"))
        return keep_velocity(world.states[:, 0])[:, :50]


class Reordering(March):
    """Asks the ego in groups, in another order than that of the batch; broken: plans
    NaN where the ego is beyond 50 m."""

    queries_ego = True

    def __init__(self, broken):
        super().__init__()
        self.broken = broken

    def replan(self, state, world, ego_plan, react=None):
        for group in torch.arange(len(world.step)).flip(0).split(2):
            wrong = self.broken & (world.states[group, 0, 0] > 50)
            react(
                group,
                keep_velocity(world.states[group, :ROWS]).masked_fill(
                    wrong[:, None, None, None], torch.nan
                ),
            )
        return super().replan(state, world, ego_plan)


@pytest.mark.parametrize("due", [[0, 1, 2, 3, 4], [1, 2, 3, 4]])
@pytest.mark.parametrize("broken", [False, True])
def test_who_raises_where_the_traffic_asks_is_named_by_its_own_scene(due, broken):
    """By the ego, and by the traffic that it is shown; where all are planned anew, and
    where some are."""
    scene_set = scenes(5, 20)
    for name in ("start", "logged"):
        scene_set.scenes[name][3, ..., 0, 0] += 60.0 if broken else 110.0

    def driven(tasks):
        pool = TrafficPool.live(
            torch.tensor(tasks), torch.zeros(len(tasks)), seed=torch.tensor(tasks)
        )
        env = environment(
            pool, Reordering(broken), batch=len(tasks), scene_set=scene_set, ego=Picky()
        )
        tensordict = env.reset()
        env.transform._planned_at = torch.tensor(
            [-5 if task in due else 0 for task in tasks]
        )
        env.step(still(tensordict))
        world = env.base_env.world()
        return TensorDict(
            {"states": world.states[:, None], "valid": world.valid[:, None]},
            [len(tasks)],
        )

    with pytest.raises(TrafficNotFinite if broken else PlannerError) as raised:
        driven([0, 1, 2, 3, 4])
    assert list(raised.value.rows) == [3]
    parts, errored = attempt(driven, [0, 1, 2, 3, 4])
    assert [task for tasks, _ in parts for task in tasks] == [0, 1, 2, 4]
    assert [task for task, _ in errored] == [3]
    assert errored[0][1]["raised_by"] == ("traffic" if broken else "ego")


def test_traffic_that_is_told_the_plan_refuses_a_policy_that_writes_none():
    class Told(March):
        knowledge = "plan"

    env = environment(live(), Told())
    with pytest.raises(InputError, match="the policy writes no"):
        advance(env, still, tensordict=env.reset(), steps=1)
    policy = EgoPolicy(IDMEgo(), env)
    advance(env, policy, tensordict=env.reset(), steps=1)


# --- all kinds of rows at once


def test_live_stored_and_recorded_rows_run_side_by_side():
    scene_set = scenes(3)
    pool = replayed(scene_set) + live(1.0, 3)
    on = March()
    env = environment(pool, on, batch=9, scene_set=scene_set)
    policy = EgoPolicy(IDMEgo(), env)
    tensordict = env.reset()
    for step in range(12):
        going_on = tensordict["agents", "states"][6:, 1:ROWS].clone()
        tensordict = policy(tensordict)
        going_on[..., 3], planned = (
            (torch.arange(3.0) + step // 5 / 10)[:, None],
            tensordict["ego", "plan"][6:].clone(),
        )
        tensordict = env.step(tensordict)["next"]
        states = tensordict["agents", "states"][:, 1:ROWS]
        assert torch.equal(states[:3], pool.parts[0].states[:, step + 1, 1:ROWS])
        assert torch.equal(states[3:6], scene_set.scenes["logged"][:, step + 1, 1:ROWS])
        torch.testing.assert_close(states[6:], keep_velocity(going_on)[:, :, 0])
        assert step % 5 or torch.equal(on.calls[-1][1], planned), (
            "replanned by what the policy has just written"
        )
    assert [steps for steps, _ in on.calls] == [[0] * 3, [5] * 3, [10] * 3], (
        "only live rows are replanned"
    )


def test_vehicles_of_replayed_rows_are_expected_to_keep_their_velocity():
    """Nobody plans there, so that the ego foresees what it does in a pool without a
    method."""
    scene_set = scenes(3)
    scene_set.scenes["logged"][:, 3:, 1, 3] = 1.0
    env = environment(mixed(scene_set), March(), batch=9, scene_set=scene_set)
    tensordict = advance(env, still, tensordict=env.reset(), steps=7)
    straight = keep_velocity(tensordict["agents", "states"][:, :ROWS])
    torch.testing.assert_close(tensordict["traffic", "plan"][3:, 1:], straight[3:, 1:])


def test_plans_are_for_the_policy_alone_and_are_not_stacked_over_time():
    observed = []
    env = environment(live(), March())

    class Watching(EgoPolicy):
        def forward(self, tensordict):
            observed.append(tensordict.get(("traffic", "plan"), None))
            return super().forward(tensordict)

    options = {
        "trust_policy": True,
        "track_traj_ids": False,
        "auto_register_policy_transforms": False,
    }
    collector = Collector(
        env, Watching(IDMEgo(), env), frames_per_batch=36, total_frames=-1, **options
    )
    data = next(iter(collector))
    assert ("traffic", "plan") not in data.keys(True)
    assert (
        "next",
        "traffic",
        "plan",
    ) not in data.keys(True)
    torch.testing.assert_close(
        observed[-1][:, 1:, 0], data["next", "agents", "states"][:, -1, 1:ROWS]
    )
    collector.shutdown()


def test_egos_that_drive_differently_meet_plans_of_their_own():
    """The same attempt twice, but one of the egos brakes: the plan of one is not that
    of the other."""
    on = synthesizer()
    pool = TrafficPool.live(
        torch.zeros(2, dtype=torch.int64),
        torch.full((2,), 2.0),
        seed=torch.tensor([5, 5]),
    )
    env = environment(pool, on, steps=20, batch=2, scene_set=scenes(1, 20))
    plans = []
    env.transform.on_plan = lambda plan: plans.append(plan.states)
    tensordict = env.reset()
    for _ in range(11):
        tensordict["action"] = torch.tensor([[0.0, 0.0], [-5.0, 0.0]])
        tensordict["ego", "plan"] = keep_velocity(env.base_env.world().states[:, 0])
        tensordict = env.step_mdp(env.step(tensordict))
    assert torch.equal(plans[0][0], plans[0][1])
    assert len(plans) == 3
    assert not torch.equal(plans[-1][0, 1:5], plans[-1][1, 1:5])
