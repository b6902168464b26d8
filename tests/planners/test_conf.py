"""The YAML files build what they name, and agree with the classes' own defaults."""

from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from e2rl.learning.bits_training import BitsSettings
from e2rl.planners.bits import BitsEgo
from e2rl.planners.ego import PLAN_STEPS
from e2rl.planners.idm_planner import IDMEgo
from e2rl.planners.lane_graph_planner import LaneGraphEgo
from e2rl.planners.log_replay import ReplayEgo
from e2rl.planners.sampling import SamplingEgo
from e2rl.run.settings import settings_of
from e2rl.sim.env import DrivingEnv, SimSettings
from tests.synthetic import make_scenes

CONF = Path(__file__).parents[2] / "conf"


EGOS = [("idm", IDMEgo), ("lane_graph", LaneGraphEgo), ("replay", ReplayEgo), ("sampling", SamplingEgo)]


@pytest.mark.parametrize(("name", "kind"), EGOS)
def test_egos(name, kind):
    ego = instantiate(OmegaConf.load(CONF / "ego" / f"{name}.yaml"))
    assert type(ego) is kind and vars(ego) == vars(kind())
    env = DrivingEnv(make_scenes(2), SimSettings(), 2)
    env.reset()
    plan = ego.plan(env.world())
    assert plan.shape == (2, PLAN_STEPS, 4) and torch.isfinite(plan).all()


def test_bits():
    """The weights apart, which `vars` would compare by identity."""
    built, default = (vars(ego) for ego in (instantiate(OmegaConf.load(CONF / "ego" / "bits.yaml")), BitsEgo()))
    for own in (built, default):
        own.pop("network")
    assert torch.equal(built.pop("noise"), default.pop("noise")) and built == default
    settings = settings_of(BitsSettings, OmegaConf.load(CONF / "train.yaml").bits, "bits")
    assert settings == BitsSettings()


def test_sim():
    settings = settings_of(SimSettings, OmegaConf.load(CONF / "sim" / "default.yaml"), "sim")
    assert settings == SimSettings()
