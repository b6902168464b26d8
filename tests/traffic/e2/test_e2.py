"""e2: a scene alone and in a batch, and what an attack may cost."""

import pytest
import torch

from e2rl.prior.sde import SamplerSettings
from e2rl.run.errors import InputError
from e2rl.traffic.e2 import e2
from e2rl.traffic.e2.pull import Pull
from tests.prior.small import small_prior
from tests.traffic.e2.traffic_scenes import replanned, scenes, synthesizer


def test_a_scene_is_planned_alike_alone_and_in_a_batch():
    on = synthesizer()
    scene = scenes(3).scenes
    for eta in (0.0, 2.0):
        _, whole = replanned(on, scene, eta=eta, seeds=[5, 6, 7])
        _, alone = replanned(on, scene[1:2], eta=eta, seeds=[6])
        torch.testing.assert_close(alone.states, whole.states[1:2], rtol=0, atol=5e-3)
        assert torch.equal(alone.route, whole.route[1:2])
        assert torch.equal(alone.adversary, whole.adversary[1:2])


@pytest.mark.parametrize("samples", [1, 6])
@pytest.mark.parametrize("sampler", ["ddim", "dpm_solver_pp", "euler_maruyama"])
def test_the_transport_budget_of_a_rollout_holds_and_is_used(sampler, samples):
    """All of it by control; a drawn path that costs more than is left is not taken, and
    may leave some."""
    scene = scenes(3).scenes

    def spent(budget):
        on = synthesizer(
            sampler=sampler,
            control={"transport_budget": budget},
            kernels={"samples": samples},
        )
        return replanned(on, scene, eta=2.0, times=3)[1].path_kl.sum(-1)

    free = spent(None)
    limit = float(free.min()) / 3
    assert limit > 0
    capped = spent(limit)
    assert (capped <= 1.001 * limit).all()
    assert (capped > (0.99 if samples == 1 else 0.4) * limit).all()
    assert (spent(0.0) == 0).all()
    torch.testing.assert_close(spent(2 * float(free.max())), free, rtol=1e-3, atol=1e-4)


@pytest.fixture
def pulls_and_kernels(monkeypatch):
    """The strengths of the pulls, and the gain and number of kernels, in a replan by
    default at intensity 1.5."""
    strengths = set()
    kernels = []
    propose = e2.propose_kernels

    class Spy(Pull):
        def __call__(self, x0, level):
            strengths.update(self.strength.tolist())
            return super().__call__(x0, level)

    def proposed(*arguments, gain, count, **options):
        kernels.append((gain.tolist(), count))
        return propose(*arguments, gain=gain, count=count, **options)

    monkeypatch.setattr(e2, "Pull", Spy)
    monkeypatch.setattr(e2, "propose_kernels", proposed)
    replanned(synthesizer(), scenes(1).scenes, eta=1.5)
    return strengths, kernels


def test_by_default_anchors_pull_by_8_and_kernels_by_6_per_intensity(pulls_and_kernels):
    assert pulls_and_kernels[0] == {8 * 1.5, 6 * 1.5}


def test_by_default_five_kernels_gain_100_nats_per_intensity(pulls_and_kernels):
    assert pulls_and_kernels[1] == [([100 * 1.5], 5)]


def test_a_budget_of_steps_without_noise_is_refused():
    prior = small_prior(sampler=SamplerSettings(churn=0.0))
    with pytest.raises(InputError, match=r"prior\.sampler\.churn=0"):
        e2.E2(prior, control={"transport_budget": 20.0})
