"""Whatever drives a vehicle: each of its steps is as long as its speed makes it, along
its heading."""

import pytest
import torch

import e2rl
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap

METHODS = (
    *(
        "nominal",
        "e2",
        "e2_pursuit",
        "e2_unbound",
        "constant_velocity",
        "idm",
        "ccdiff",
        "ctg",
        "ctg_adv",
    ),
    *("diffscene", "safe_sim_opt", "cat", "strive"),
)  # all that drive; `replay` is the recording
SLACK = 0.03  # m a step: who stands is held where it is, whatever it says below 0.5 m/s


@pytest.fixture(scope="module")
def recorded():
    return e2rl.load_scenes("bundled", num_scenes=6), e2rl.load_prior()


def deviations(rollouts):
    """Distance [n] m by which steps of vehicles differ from the mean speed along the
    mean heading, but of those on their recording, which begins at an estimate of it."""
    states = rollouts.states.double()
    logged = rollouts.logged.double()
    both = rollouts.valid[:, 1:] & rollouts.valid[:, :-1] & rollouts.simulated[:, None]
    both[..., 0] = False
    replays = (states - logged)[..., :2].norm(dim=-1) < 1e-3
    replays[:, 0] = True
    both &= ~(replays[:, 1:] & replays[:, :-1])
    turn = wrap(states[:, 1:, :, 2] - states[:, :-1, :, 2])
    heading = states[:, :-1, :, 2] + turn / 2
    speed = (states[:, 1:, :, 3] + states[:, :-1, :, 3]) / 2
    expected = DT * speed[..., None] * torch.stack([heading.cos(), heading.sin()], -1)
    return (states[..., :2].diff(dim=1) - expected).norm(dim=-1)[both]


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_vehicle_moves_as_fast_as_it_says(recorded, method):
    scenes, prior = recorded
    rollouts = e2rl.roll_out(
        scenes,
        e2rl.make_ego("lane_graph"),
        traffic=e2rl.make_traffic(method, prior),
        eta=2.0,
    )
    found = deviations(rollouts)
    assert len(found) > 100
    assert found.max() < SLACK
