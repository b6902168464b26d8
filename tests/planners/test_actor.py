"""The learned ego: its observation is the environment's, its plan comes true, its file
fits or is refused."""

import copy
import json

import pytest
import torch

from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego import PLAN_STEPS
from e2rl.planners.network import Architecture, find_weights
from e2rl.planners.reference import follow
from e2rl.planners.trunk import Normaliser
from e2rl.run.errors import InputError
from e2rl.run.files import seal
from e2rl.sim.env import DrivingEnv
from e2rl.sim.observation import observation_layout
from e2rl.sim.settings import SimSettings
from tests.synthetic import make_scenes


def wild(ego, scale=0.3):
    """Give the untrained network an opinion of its own."""
    torch.manual_seed(0)
    torch.nn.init.normal_(ego.network.network.trunk.last.weight, std=scale)
    return ego


@pytest.mark.parametrize(("vehicles", "true"), [(8, 1), (1, 15)])
def test_its_plan_comes_true(vehicles, true):
    """Planning sees what the environment observes: among others the first step is where
    the action leads; alone on the road the whole plan is, with the actions held as in
    it."""
    env = DrivingEnv(
        make_scenes(
            2,
            num_vehicles=vehicles,
            num_vrus=2 * (vehicles > 1),
        ),
        SimSettings(),
        2,
    )
    ego = wild(
        ActorEgo(
            hidden=(16,),
            room=None,
        ),
        0.1,
    )
    td = env.reset()
    for step in range(15):
        if step % true == 0:
            plan = ego.plan(env.world())
            assert plan.shape == (2, PLAN_STEPS, 4)
            assert torch.equal(plan, ego.plan(env.world()))
        if step % min(true, 5) == 0:
            action = ego.act(env.world(), td["observation"], plan)
        td = env.step(td.set("action", action))["next"].exclude("reward")
        assert torch.allclose(
            env.world().states[:, 0], plan[:, step % true], atol=1e-3
        ), step


def test_plans_expect_the_others_plans():
    """A leader that plans to halt makes the ego plan to halt; by its velocity alone it
    would go on."""
    env = DrivingEnv(
        make_scenes(2, vehicles=[(0.0, 0, 10.0), (25.0, 0, 10.0)]), SimSettings(), 2
    )
    env.reset()
    ego = ActorEgo(hidden=(8,))
    world = env.world()
    going_on = ego.plan(world)
    world.plan = world.states[:, : env.scene["route_log"].shape[1], None].repeat(
        1, 1, PLAN_STEPS, 1
    )
    world.plan[..., 3] = 0.0
    halting = ego.plan(world)
    assert (going_on[:, -1, 3] > 8).all()
    assert (halting[:, -1, 3] < 3).all()


def test_the_network_can_override_the_reference():
    ego = ActorEgo(
        hidden=(8,),
        slack=None,
        room=None,
    )
    env = DrivingEnv(make_scenes(2), SimSettings(), 2)
    observation = env.reset()["observation"]
    assert torch.allclose(
        ego.network.network.deterministic(observation),
        follow(observation)[..., :2],
        atol=1e-4,
    )
    with torch.no_grad():
        ego.network.network.trunk.last.bias[:2] = torch.tensor([8.0, -8.0])
    assert torch.allclose(
        ego.network.network.deterministic(observation),
        torch.tensor([5.0, -1.6]),
        atol=1e-2,
    )


def test_nothing_learned_accelerates_into_a_vehicle_that_is_followed_or_a_pedestrian():
    """It may brake harder than its reference; against oncoming traffic, whose duty it
    is too, it decides alone."""
    follows = make_scenes(2, vehicles=[(0.0, 0, 10.0), (18.0, 0, 6.0)])
    oncoming = make_scenes(2, vehicles=[(0.0, 0, 10.0), (18.0, 0, 6.0)])
    oncoming.scenes["start"][:, 1, 2] = torch.pi
    walks = make_scenes(
        2,
        num_vehicles=1,
        num_vrus=1,
    )
    walks.scenes["start"][:, 32, :3] = torch.tensor([18.0, 0.0, torch.pi / 2])
    bounded = ActorEgo(
        hidden=(8,),
        slack=0.5,
        room=None,
    )
    free = ActorEgo(
        hidden=(8,),
        slack=None,
        room=None,
    )

    def accelerations(scenes, push):
        observation = DrivingEnv(scenes, SimSettings(), 2).reset()["observation"]
        for ego in (bounded, free):
            with torch.no_grad():
                ego.network.network.trunk.last.bias[0] = push
        result = [ego.decide(observation)[:, 0] for ego in (bounded, free)]
        return *result, follow(observation)

    for scenes in (follows, walks):
        ours, unbound, reference = accelerations(scenes, 8.0)
        assert (unbound > 4.9).all()
        assert torch.allclose(ours, reference[:, 2] + 0.5, atol=1e-3)
        assert (ours < -1.0).all()
        ours, unbound, reference = accelerations(scenes, -8.0)
        assert torch.equal(ours, unbound)
        assert (ours < reference[:, 0] - 0.5).all()
    ours, _, _ = accelerations(oncoming, 8.0)
    assert (ours > 4.9).all()


def test_with_room_ahead_the_reference_drives_and_without_it_the_network():
    ego = wild(
        ActorEgo(
            hidden=(8,),
            slack=None,
            room=2.0,
        )
    )
    alone = copy.deepcopy(ego)
    alone.network.network.room = None
    observation = DrivingEnv(make_scenes(2), SimSettings(), 2).reset()["observation"]
    names = [entry.name for entry in observation_layout()]
    for room, weight in ((2.5, 0.0), (2.0, 0.0), (1.5, 0.5), (1.0, 1.0), (-0.5, 1.0)):
        observation[
            :, [names.index(f"manoeuvre.{accel}.+0.gap") for accel in ("-1", "+1")]
        ] = room / 3.0
        (ours, _), (network, _) = (
            ego.network.network(observation),
            alone.network.network(observation),
        )
        usual = ego.network.network.offset(observation)[:, :2]
        torch.testing.assert_close(ours, torch.lerp(usual, network, weight))


def test_normaliser_equals_the_statistics_of_all_it_saw_and_is_frozen_otherwise():
    normaliser = Normaliser(3)
    parts = [2 + 3 * torch.randn(n, 3) for n in (5, 100, 31)]
    for part in parts:
        normaliser.observe(part)
        normaliser(part)
    everything = torch.cat(parts)
    assert torch.allclose(normaliser.mean, everything.mean(0), atol=1e-5)
    assert torch.allclose(
        normaliser.variance, everything.var(0, correction=0), rtol=1e-4
    )


def test_normalised_numbers_are_clipped_at_5_standard_deviations():
    assert Normaliser(1)(torch.tensor([[100.0], [-100.0]])).tolist() == [[5.0], [-5.0]]


def test_file_round_trip(tmp_path):
    first = wild(
        ActorEgo(
            hidden=(8,),
            slack=0.3,
            room=3.0,
        )
    )
    first.network.normaliser.observe(
        torch.randn(10, first.network.normaliser.mean.shape[0])
    )
    folder = tmp_path / "checkpoints" / "round-000001"
    folder.mkdir(parents=True)
    first.network.save(folder / "actor.safetensors")
    seal(folder)
    assert (
        find_weights(tmp_path) == find_weights(folder) == folder / "actor.safetensors"
    )
    second = ActorEgo(
        hidden=(8,),
        checkpoint=str(tmp_path),
    )
    assert second.network.architecture == first.network.architecture
    observed = DrivingEnv(make_scenes(2), SimSettings(), 2).reset()
    for ask in (
        lambda ego: ego.decide(observed["observation"]),
        lambda ego: ego.network.critic(observed)["state_value"].clone(),
    ):
        assert torch.equal(ask(first), ask(second))


def test_the_network_can_let_go_of_the_reference():
    network = ActorEgo(
        hidden=(8,),
        room=None,
    ).network.network
    observation = DrivingEnv(make_scenes(2), SimSettings(), 2).reset()["observation"]
    with torch.no_grad():
        network.trunk.last.bias[:] = torch.tensor([0.3, -0.2, -1.0, -1.0])
    expected = network.middle + network.reach * torch.tensor([0.3, -0.2]).tanh()
    torch.testing.assert_close(
        network.deterministic(observation), expected.expand(2, 2)
    )


def test_other_bounds_damage_and_other_versions_are_refused(tmp_path, monkeypatch):
    file = tmp_path / "actor.safetensors"
    network = ActorEgo(hidden=(8,)).network
    network.save(file)
    with pytest.raises(
        InputError, match=r"bounds .*5\.0, .* not .*2\.0.*set sim\.max_"
    ):
        ActorEgo(
            hidden=(8,),
            max_acceleration=2.0,
            checkpoint=str(file),
        )
    bounds = (
        {"room": 0.0},
        {"room": float("nan")},
        {"slack": float("nan")},
        {"slack": -0.1},
        {"low": [1.0]},
    )
    header = json.loads(network.architecture.header())
    for change in (
        {"observation": 12},
        {"least_scale": 0.05},
        {"hidden": [10**9]},
        {"hidden": []},
        *bounds,
    ):
        changed = json.dumps(header | change)
        monkeypatch.setattr(Architecture, "header", lambda self, text=changed: text)
        network.save(file)
        with pytest.raises(InputError, match="another architecture"):
            ActorEgo(
                hidden=(8,),
                checkpoint=str(file),
            )
    file.write_bytes(b"no weights")
    with pytest.raises(InputError, match="damaged"):
        ActorEgo(
            hidden=(8,),
            checkpoint=str(file),
        )


def test_noise_is_the_networks_alone_and_ends_with_the_block():
    ego = wild(
        ActorEgo(
            hidden=(8,),
            room=None,
        )
    )
    env = DrivingEnv(make_scenes(2), SimSettings(), 2)
    observation = env.reset()["observation"]
    network = ego.network.network
    clean = network.deterministic(observation)
    with network.noisy(0.3, 1.0):
        assert not torch.equal(network.deterministic(observation), clean)
        torch.nn.init.zeros_(network.trunk.last.weight)
        assert torch.allclose(
            network.deterministic(observation), follow(observation)[..., :2], atol=1e-4
        )
    assert torch.equal(
        network.deterministic(observation), network.deterministic(observation)
    )
