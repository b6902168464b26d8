"""D' of two methods: every scene is attacked by one of them, as it alone would, whatever the batch."""

import torch

from e2rl.learning.attack import drawn, mixture

SCENES = torch.tensor([3, 0, 4, 1, 2, 9, 7])


def marked(mark, lost=()):
    """A method that marks its rows, and cannot make the scenes `lost`."""

    def synthesize(ego, scenes, eta, seed, *template):
        there = [row for row, scene in enumerate(scenes.tolist()) if scene not in lost]
        made = {"scene_index": scenes[there], "eta": eta[there], "mark": torch.full((len(there),), mark)}
        made |= {"template": template[0][there]} if template else {}
        return made | {"ended": {row: {"reason": mark} for row in range(len(scenes)) if row not in there}}

    return synthesize


def test_rows_come_in_the_order_of_the_scenes_each_by_its_own_method():
    eta, template = torch.arange(7.0), torch.arange(7)
    made = mixture(marked(1), marked(2), 0.5)(None, SCENES, eta, 5, template)
    assert torch.equal(made["scene_index"], SCENES) and torch.equal(made["eta"], eta)
    assert torch.equal(made["template"], template) and not made["ended"]
    assert torch.equal(made["mark"] == 2, drawn(SCENES, 5, 0.5)) and set(made["mark"].tolist()) == {1, 2}


def test_who_attacks_a_scene_does_not_depend_on_its_batch():
    whole = drawn(SCENES, 5, 0.5)
    assert torch.equal(whole, torch.cat([drawn(part, 5, 0.5) for part in SCENES.split(2)]))
    assert any(not torch.equal(whole, drawn(SCENES, seed, 0.5)) for seed in range(6, 12))


def test_the_share_is_that_of_the_scenes():
    scenes = torch.arange(4000)
    assert abs(drawn(scenes, 1, 0.3).float().mean() - 0.3) < 0.03
    assert not drawn(scenes, 1, 0.0).any() and drawn(scenes, 1, 1.0).all()


def test_rows_that_a_method_cannot_make_are_named_by_their_place():
    made = mixture(marked(1, lost=[4]), marked(2, lost=[4]), 0.5)(None, SCENES, torch.ones(7), 5)
    assert made["scene_index"].tolist() == [3, 0, 1, 2, 9, 7] and set(made["ended"]) == {2}
