"""The prior's noise as normals: what moves what, and that nominal traffic has its law."""

import pytest
import torch

from e2rl.api import load_prior, make_ego, make_traffic
from e2rl.driving.setup import Method, Setup, Task
from e2rl.sim.settings import SimSettings
from e2rl.tail.noise import ChosenNoise, NoiseLayout
from e2rl.traffic.grouping import noise_of
from e2rl.traffic.traffic import REPLAN_STEPS
from tests.synthetic import make_scenes

SEED = 7


@pytest.fixture(scope="module")
def scenes():
    return make_scenes(2)


@pytest.fixture(scope="module")
def prior():
    return load_prior(sampler={"steps": 2})


@pytest.fixture(scope="module")
def layout(scenes, prior):
    batch = scenes.batch([0])
    return NoiseLayout.of(
        prior, vehicles=batch["route_valid"].shape[1], horizon=scenes.steps
    )


@pytest.fixture(scope="module")
def drive(scenes, prior, layout):
    """Rollouts [P] of the first scene with normals [P, V, D]."""
    setup = Setup(scenes, make_ego("idm"), ego_name="idm", sim=SimSettings())

    def rollouts(normals):
        traffic = ChosenNoise(prior, layout)
        traffic.normals = normals
        tasks = [Task(0, 0, noise=row) for row in range(len(normals))]
        return setup.roll_out(Method("tail", traffic), tasks)

    return rollouts


def normals_of_seed(layout, prior):
    """The numbers that nominal traffic draws from SEED."""
    seed = torch.tensor([SEED])
    uniform = noise_of(seed, torch.tensor([0]), (layout.vehicles,), uniform=True)
    shape = (layout.steps, layout.vehicles, 12)
    parts = [
        noise_of(seed, torch.tensor([1 + replan]), shape)[0].transpose(0, 1).flatten(1)
        for replan in range(layout.replans)
    ]
    route = torch.special.ndtri(uniform.double())[0, :, None].float()
    return torch.cat([route, *parts], 1)[None]


def test_the_numbers_of_a_seed_drive_the_rollout_of_that_seed(
    drive, layout, prior, scenes
):
    setup = Setup(scenes, make_ego("idm"), ego_name="idm", sim=SimSettings())
    nominal = setup.roll_out(
        Method("nominal", make_traffic("nominal", prior)), [Task(0, 0, noise=SEED)]
    )
    chosen = drive(normals_of_seed(layout, prior))
    torch.testing.assert_close(chosen.states, nominal.states, atol=1e-4, rtol=0)


def test_a_number_acts_from_its_replan_on(drive, layout):
    generator = torch.Generator().manual_seed(0)
    shape = (1, layout.vehicles, layout.numbers)
    normals = torch.randn(shape, generator=generator)
    for replan in (1, layout.replans - 1):
        changed = normals.clone()
        later = layout.replan_of() >= replan
        changed[..., later] = -changed[..., later]
        both = drive(torch.cat([normals, changed]))
        begin = replan * REPLAN_STEPS
        assert torch.equal(both.states[0, : begin + 1], both.states[1, : begin + 1])
        assert not torch.equal(both.states[0], both.states[1])


def test_the_layout_counts_a_route_and_the_noise_of_every_replan(prior):
    layout = NoiseLayout.of(prior, vehicles=3, horizon=80)
    assert layout.replans == 16
    assert layout.numbers == 1 + 16 * 2 * 12
    assert torch.equal(layout.replan_of().bincount(), torch.tensor([25] + [24] * 15))
