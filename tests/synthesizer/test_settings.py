from dataclasses import asdict
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from e2rl.synthesizer.anchoring import AnchorSettings
from e2rl.synthesizer.control import ControlSettings
from e2rl.synthesizer.feasibility import FeasibilitySettings
from e2rl.synthesizer.interception import InterceptionSettings
from e2rl.synthesizer.potentials import PotentialSettings
from e2rl.synthesizer.reasoner import ReasonerSettings
from e2rl.synthesizer.skeleton import SkeletonSettings
from e2rl.synthesizer.topology import TopologySettings

CONFIG = Path(__file__).parents[2] / "conf" / "synthesizer" / "e2.yaml"


@pytest.mark.parametrize(
    "key, settings",
    [
        ("topology", TopologySettings),
        ("feasibility", FeasibilitySettings),
        ("reasoner", ReasonerSettings),
        ("skeleton", SkeletonSettings),
        ("anchor", AnchorSettings),
        ("interception", InterceptionSettings),
        ("potentials", PotentialSettings),
        ("control", ControlSettings),
    ],
)
def test_the_config_lists_every_setting(key, settings):
    config = OmegaConf.load(CONFIG)[key]
    assert set(config) == set(asdict(settings()))
    settings(**config)
