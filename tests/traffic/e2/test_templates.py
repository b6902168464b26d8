"""Causal templates limit the coalitions of e2, scene by scene; `full` changes nothing."""

import pytest
import torch

import e2rl
from e2rl.planners.idm_planner import IDMEgo
from e2rl.scenes.builder import BuildSettings
from e2rl.scenes.bundled import BundledSource
from e2rl.scenes.source import load_scenes
from e2rl.sim.env import SimSettings
from e2rl.traffic.rollout import roll_out, synthesize_traffic
from e2rl.traffic.traffic import CHAIN, FULL, PAIR, SINGLE
from tests.traffic.e2.traffic_scenes import scenes, synthesizer

COUNT = 16


@pytest.fixture(scope="module")
def bundled(tmp_path_factory):
    """The bundled tune scenes, the shipped prior, and e2 as configured but for few denoising steps."""
    build = BuildSettings(field_cells=128, steps=20)
    source = BundledSource(cache=str(tmp_path_factory.mktemp("cache")), workers=1, build=build)
    return load_scenes(source, COUNT, split="tune"), e2rl.make_traffic("e2", e2rl.load_prior(sampler={"steps": 2}))


def selections(bundled, template):
    """Coalitions [K, V] and targets chosen in a rollout of every scene, with the template of each row."""
    scene_set, on = bundled
    index, found = torch.arange(COUNT), []
    on.on_selection = lambda chosen: found.append((chosen.seed, chosen.coalition, chosen.target))
    driven = roll_out(
        scene_set, index, index, torch.full((COUNT,), 3.0), IDMEgo(), on, SimSettings(), template=template
    )
    on.on_selection = None
    return found, driven


def test_coalitions_on_the_bundled_scenes_keep_to_their_template(bundled):
    template = torch.arange(COUNT) % 3
    found, driven = selections(bundled, template)
    most = {SINGLE: 1, PAIR: 2, CHAIN: 1}
    seen = dict.fromkeys(most, 0)
    for seed, coalition, target in found:
        for row, code in enumerate(template[seed].tolist()):
            near, through = int((target[row] == 0).sum()), int((target[row] > 0).sum())
            assert near <= most[code] and (code == CHAIN or through == 0)
            assert near + through == int(coalition[row].sum())
            seen[code] = max(seen[code], near)
    assert seen == most, "and use it up"
    assert driven["adversaries"].any()


def test_full_is_what_the_settings_say_bit_for_bit(bundled):
    _, whole = selections(bundled, None)
    found, again = selections(bundled, torch.full((COUNT,), FULL))
    assert all(torch.equal(whole[name], again[name]) for name in ("states", "valid", "adversaries", "routes"))
    assert max(int((target == 0).sum(1).max()) for _, _, target in found) == 3


def test_templates_reach_the_rows_of_synthesized_traffic():
    """Equal scenes of equal noise: a vehicle more acts where the template allows it."""
    scene_set, on = scenes(4), synthesizer(reselect=0, responsibility="none")
    synthesize = synthesize_traffic(scene_set, on, SimSettings(), batch=3)
    index, eta = torch.arange(4), torch.full((4,), 3.0)

    def acting(*template):
        return synthesize(IDMEgo(), index, eta, 0, *template)["adversaries"].sum(1)

    one, two, most = (acting(torch.full((4,), code)) for code in (SINGLE, PAIR, FULL))
    assert (one <= 1).all() and (two <= 2).all() and (one <= two).all() and two.max() == 2
    assert torch.equal(most, acting())


def test_a_random_coalition_has_the_size_of_its_template():
    on = synthesizer(support="random", reselect=0)
    synthesize = synthesize_traffic(scenes(4), on, SimSettings())
    given = torch.tensor([SINGLE, PAIR, SINGLE, PAIR])
    adversaries = synthesize(IDMEgo(), torch.arange(4), torch.full((4,), 3.0), 0, given)["adversaries"].sum(1)
    assert (adversaries <= given + 1).all() and adversaries.any()
