"""The evader: in danger, and there alone, the actor begins from a planner's action, while
it learns as while it drives."""

import json

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from e2rl.commands.export_policy import export_actor
from e2rl.planners.actor import ActorEgo
from e2rl.planners.chunks import take
from e2rl.planners.evader import Evader, Evasions
from e2rl.planners.network import STEEPEST, Architecture
from e2rl.planners.reference import EVASION, follow
from e2rl.planners.sampling import SamplingEgo
from e2rl.run.errors import InputError
from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv
from e2rl.sim.settings import SimSettings
from tests.planners.test_actor import wild
from tests.synthetic import make_scenes

ROOM = 1.0


def near_and_free():
    """Two scenes: a vehicle stands 18 m ahead of the ego at 10 m/s; nobody is near."""
    scenes = make_scenes(2, vehicles=[(0.0, 0, 10.0), (18.0, 0, 0.0)], num_vrus=0)
    for name in ("start", "logged"):
        scenes.scenes[name][1, ..., 1, 0] = 300.0
    return scenes


def environment(hold=1, **settings):
    return DrivingEnv(near_and_free(), SimSettings(**settings), 2, hold=hold)


def both():
    """A request to reset to either scene."""
    return TensorDict({"scene_index": torch.arange(2)[:, None]}, [2])


def evading(**settings):
    return ActorEgo(hidden=(8,), slack=None, room=ROOM, evades=True, **settings)


def test_the_planner_acts_where_the_route_follower_has_too_little_room():
    env = environment()
    observation = env.reset(both())["observation"]
    room = follow(observation)[:, 3]
    assert room[0] < ROOM < room[1]
    action = Evader(ROOM).actions(env.world(), observation)
    plan = SamplingEgo().plan(take(env.world(), torch.tensor([0])))
    driven = torch.cat([env.world().states[:1, :1], plan[:, :1]], 1)
    torch.testing.assert_close(action[:1], dynamics.inverse(driven)[:, 0])
    assert action[1].isnan().all()


def test_an_untrained_actor_drives_as_the_planner_in_danger_and_as_its_route_follower():
    env = environment()
    observation = env.reset(both())["observation"]
    ego = evading()
    action = ego.act(env.world(), observation, torch.empty(0))
    expected = ego.evader.actions(env.world(), observation)
    expected[1] = follow(observation)[1, :2]
    network = ego.network.network
    reach = STEEPEST * network.reach
    expected = expected.clamp(network.middle - reach, network.middle + reach)
    torch.testing.assert_close(action, expected, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_nothing_learned_accelerates_at_a_followed_vehicle_or_undoes_braking():
    observation = environment().reset(both())["observation"][:1]
    network = ActorEgo(hidden=(8,), slack=0.5, room=ROOM, evades=True).network.network
    bound = follow(observation)[0, 2] + 0.5
    assert bound < -1.0
    evasion = torch.tensor([[2.0, 0.1]])
    torch.testing.assert_close(network.deterministic(observation, evasion), evasion)
    network.trunk.last.bias[0] = 8.0
    assert network.deterministic(observation, evasion)[0, 0] == pytest.approx(2.0)
    alone = network.deterministic(observation)[0, 0]
    assert alone == pytest.approx(bound.item(), abs=1e-3)
    braking = evasion.clone()
    braking[0, 0] = bound - 2.0
    action = network.deterministic(observation, braking)[0, 0]
    assert action == pytest.approx(bound.item() - 1.5, abs=1e-3), "slack above it"


def test_in_danger_it_announces_the_planner_s_plan():
    env = environment()
    env.reset(both())
    world = env.world()
    plan = evading().plan(world)
    assert torch.equal(plan[:1], SamplingEgo().plan(take(world, torch.tensor([0]))))
    without = ActorEgo(hidden=(8,), slack=None, room=ROOM)
    assert torch.equal(plan[1], without.plan(world)[1])


def test_what_learns_acts_as_what_drives():
    """After steps and resets of some environments the key is what the evader says of
    the present world, so that the collected action is `act`'s."""
    ego = wild(evading(), 1.0)
    base = environment()
    env = TransformedEnv(base, Evasions(ego.evader, hold=1))
    data = env.reset(both())
    endangered = 0
    for _ in range(40):
        world = base.world()
        evasion = ego.evader.actions(world, data["observation"])
        torch.testing.assert_close(data[EVASION], evasion, equal_nan=True)
        endangered += int((~evasion.isnan()).any())
        loc, _ = ego.network.network(data["observation"], data[EVASION])
        action = ego.network.network.middle + ego.network.network.reach * loc.tanh()
        torch.testing.assert_close(
            action, ego.act(world, data["observation"], torch.empty(0))
        )
        _, data = env.step_and_maybe_reset(data.set("action", action))
    assert endangered > 5


def test_a_held_action_is_the_mean_of_the_plan_s():
    env = environment()
    observation = env.reset(both())["observation"]
    action = Evader(ROOM).actions(env.world(), observation, hold=2)
    plan = SamplingEgo().plan(take(env.world(), torch.tensor([0])))
    driven = torch.cat([env.world().states[:1, :1], plan[:, :2]], 1)
    torch.testing.assert_close(action[0], dynamics.inverse(driven)[0].mean(0))


def test_an_actor_s_file_says_whether_it_evades(tmp_path):
    evading().network.save(tmp_path / "actor.safetensors")
    assert ActorEgo(checkpoint=str(tmp_path)).evader is not None
    older = json.loads(ActorEgo(hidden=(8,)).network.architecture.header())
    del older["evades"]
    assert not Architecture.of_header(json.dumps(older)).evades


def test_what_sees_the_observation_alone_cannot_evade(tmp_path):
    evading().network.save(tmp_path / "actor.safetensors")
    with pytest.raises(InputError, match="evades"):
        export_actor(str(tmp_path), tmp_path / "policy.pt")
    assert not (tmp_path / "policy.pt").exists()


@pytest.mark.parametrize("missing", [{"room": None}, {"reference": False}])
def test_danger_is_defined_by_room_and_the_route_follower(missing):
    with pytest.raises(InputError, match=r"ego\.evades=true: it needs"):
        ActorEgo(**({"room": ROOM, "evades": True} | missing))


def test_an_environment_with_evasions_keeps_its_specs():
    check_env_specs(TransformedEnv(environment(), Evasions(Evader(ROOM), hold=1)))
