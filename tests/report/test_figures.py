"""The figures of intensity and of a skeleton: what stands where, in pixels of the image."""

import math

import numpy as np
import pytest
import torch

from e2rl.evaluation.rollout_files import Source, write_rollouts
from e2rl.report import drawing
from e2rl.report.intensity import GAP, intensity_figure
from e2rl.report.picture import SIDE
from e2rl.report.skeleton_figure import SkeletonPicture, skeleton_figure
from e2rl.report.videos import load_replay
from e2rl.traffic.e2.skeleton import Selection
from e2rl.traffic.e2.topology import TopologySettings, pair_weights
from tests.metrics.test_contact import course, scene
from tests.report.pixels import pixel_at, rgb

EGO, AHEAD, FAR, ASIDE = course(0, 0, 0, 10), course(25, 0, 0, 6), course(50, 0, 0, 4), course(0, 25, 1.0, 0)


def written(folder, *courses, eta=2.0):
    rollouts = scene(*courses, adversaries=[1]) | {"eta": torch.tensor([eta])}
    (path,) = write_rollouts(folder / f"{eta}", rollouts, Source("made", "test", "e2", "idm"))
    return path


def test_panels_stand_by_eta_at_their_contacts_and_without_one_at_the_first_of_the_stronger(tmp_path):
    paths = [written(tmp_path, EGO, course(x, 0, 0, 5), eta=eta) for eta, x in ((0.0, 70), (1.0, 35), (3.0, 20))]
    figure = drawing.image_of(intensity_figure(paths))
    assert figure.size == (2 * SIDE + GAP, 2 * SIDE + GAP)
    replays = [load_replay(path, 60.0, SIDE) for path in paths]
    assert replays[0].contact is None and replays[1].contact > replays[2].contact
    for index, (time, phase) in enumerate(
        ((replays[1].contact, None), (replays[1].contact, 0.25), (replays[2].contact, 0.25))
    ):
        left, top = (index % 2) * (SIDE + GAP), (index // 2) * (SIDE + GAP)
        panel = figure.crop((left, top, left + SIDE, top + SIDE))
        assert same_picture(panel, replays[index].picture(time, phase=phase))
        assert not same_picture(panel, replays[index].picture(time - 20, phase=phase))
    assert figure.getpixel((2 * SIDE, 2 * SIDE)) == rgb(drawing.PANEL), "three panels leave a place empty"


def same_picture(one, other):
    """All pixels but for one in ten thousand, since where a panel stands changes the rounding of its edges."""
    return (np.asarray(one) != np.asarray(other)).any(-1).mean() < 1e-4


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Vehicle 2 acts on 1, which acts on the ego; 3 stands aside and is a candidate that was not taken."""
    rollout = load_replay(written(tmp_path_factory.mktemp("run"), EGO, AHEAD, FAR, ASIDE)).rollout
    settings = TopologySettings()
    reference = torch.as_tensor(rollout["states"][:50:5])[None]
    size = torch.as_tensor(rollout["size"])[None, None].expand(*reference.shape[:3], 2)
    weights = pair_weights(reference, torch.ones(reference.shape[:3], dtype=torch.bool), size, settings)
    coalition, candidates = (torch.tensor([[False, True, True, third]]) for third in (False, True))
    chosen = Selection(
        torch.tensor([0]),
        torch.tensor([0]),
        reference,
        0.5 * torch.arange(10.0)[None],
        weights,
        candidates,
        coalition,
        coalition,
        torch.tensor([[-1, 0, 1, -1]]),
        settings,
    )
    return SkeletonPicture(rollout, chosen)


def test_the_moment_is_that_of_the_greatest_risk_of_the_links(shown):
    own = shown.selection.weights[0, :, 1, 0] + shown.selection.weights[0, :, 2, 1]
    assert shown.time == pytest.approx(0.5 * int(own.argmax())) and own.max() > own[0]
    assert shown.nodes() == [0, 1, 2]


def test_times_of_the_matrix_are_those_the_weights_came_from(shown):
    for ttc in (0.0, 0.7, 3.0, 7.5):
        weight = 1 / (1 + math.exp((ttc - shown.settings.tau_max) / shown.settings.beta))
        assert shown.ttc(weight) == pytest.approx(ttc)


def test_vehicles_have_the_colour_of_their_part(shown):
    assert [shown.colour(agent) for agent in range(4)] == [
        drawing.EGO,
        drawing.ADVERSARY,
        drawing.ADVERSARY,
        drawing.VULNERABLE,
    ]
    assert shown.colour(9) == drawing.BACKGROUND, "a pedestrian is in no risk graph"
    figure, (axes,) = drawing.new_panels(1, 600, 0, 0)
    shown.chain(axes)
    for agent in range(3):
        assert pixel_at(drawing.image_of(figure), axes, shown.now[agent, :2] - (1.5, 0.5)) == rgb(shown.colour(agent))


def test_the_figure_has_three_panels(shown):
    figure = drawing.image_of(skeleton_figure(shown.rollout, shown.selection))
    assert figure.size[0] > 2.5 * figure.size[1]
    assert len(figure.getcolors(1 << 20)) > 50
