"""conf/synthesizer/e2.yaml lists every setting of e2 and what e2 does by default; what is no setting is refused."""

from dataclasses import asdict
from inspect import signature
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from e2rl.run.errors import InputError
from e2rl.traffic.e2.e2 import E2, PARTS
from tests.traffic.e2.traffic_scenes import synthesizer

CONFIG = OmegaConf.load(Path(__file__).parents[3] / "conf" / "synthesizer" / "e2.yaml")


def test_the_file_lists_the_groups_of_settings_and_builds_e2():
    own = set(signature(E2).parameters) - {"prior", "parts"}
    assert set(CONFIG) == {"_target_", "name", *own, *PARTS}
    on = synthesizer(**{key: CONFIG[key] for key in (*own, *PARTS)})
    assert (on.support, on.reselect) == (CONFIG.support, CONFIG.reselect) and set(on.settings) == set(PARTS)


@pytest.mark.parametrize("part", PARTS)
def test_every_group_lists_every_setting(part):
    assert set(CONFIG[part]) == set(asdict(PARTS[part]()))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"support": "everybody"}, "synthesizer.support=everybody"),
        ({"samples": 4}, "synthesizer.samples"),
        ({"control": {"strength": 2}}, "synthesizer.control.strength"),
        ({"control": {"gradient": "none"}}, "synthesizer.control.gradient=none"),
    ],
)
def test_what_is_no_setting_is_refused_by_name(wrong, message):
    with pytest.raises(InputError, match=message):
        synthesizer(**wrong)
