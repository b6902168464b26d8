"""Rollouts keep to their device: what a GPU would refuse is refused here without one."""

import pytest
import torch

from e2rl.planners.lane_graph_planner import LaneGraphEgo
from e2rl.planners.sampling import SamplingEgo
from e2rl.sim.settings import SimSettings
from e2rl.traffic.baselines.ccdiff import CCDiff
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.rollout import roll_out
from tests.devices import device_of, pretended_device
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import scenes, synthesizer


def test_tensors_of_two_devices_do_not_meet():
    with pretended_device():
        here = torch.ones(3)
        place = torch.ones(3, device="cuda")
        assert device_of(place + 1).type == "cuda"
        assert torch.equal((place * 2).cpu(), here * 2)
        for wrong in (
            lambda: here + place,
            lambda: here[torch.zeros(1, dtype=torch.int64, device="cuda")],
            lambda: torch.stack([here, place]),
            lambda: place.numpy(),
            lambda: torch.nn.Linear(3, 3)(place),
        ):
            with pytest.raises(AssertionError):
                wrong()


@pytest.mark.parametrize(
    ("method", "ego"),
    [("e2", LaneGraphEgo), ("ccdiff", SamplingEgo), ("nominal", LaneGraphEgo)],
)
def test_a_rollout_keeps_to_its_device_and_is_that_of_the_cpu(method, ego):
    scene_set = scenes(2, steps=10)
    index = torch.arange(2)

    def driven(device):
        on = {
            "e2": synthesizer,
            "ccdiff": lambda: CCDiff(small_prior(0)),
            "nominal": lambda: NominalTraffic(small_prior(0)),
        }
        traffic = on[method]()
        traffic.prior.to(device)
        return roll_out(
            scene_set,
            index,
            seed=index,
            eta=torch.full((2,), 2.0),
            ego=ego(),
            traffic=traffic,
            sim=SimSettings(),
            device=device,
        )

    with pretended_device():
        place = driven("cuda")
    here = driven("cpu")
    assert torch.equal(place.states, here.states)
    assert torch.equal(place.adversaries, here.adversaries)
