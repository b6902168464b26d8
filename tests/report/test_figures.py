"""Figures: intensity and skeleton, what stands where in pixels of the image; PNG and PDF files."""

import math
import re
import zlib

import numpy as np
import pytest
import torch
from PIL import Image

from e2rl.metrics.score import score_rollouts
from e2rl.report import drawing
from e2rl.report.drawing import add_legend, new_panels, save_figure
from e2rl.report.intensity import GAP, intensity_figure
from e2rl.report.picture import SIDE, Replay
from e2rl.report.plots import plain_figure
from e2rl.report.skeleton_figure import SkeletonPicture, skeleton_figure
from e2rl.sim.rollout_file import Failure
from e2rl.traffic.e2.skeleton import Selection
from e2rl.traffic.e2.topology import TopologySettings, pair_weights
from tests.metrics.test_contact import course, scene
from tests.report.pixels import pixel_at, rgb

EGO, AHEAD, FAR, ASIDE = course(0, 0, 0, 10), course(25, 0, 0, 6), course(50, 0, 0, 4), course(0, 25, 1.0, 0)


def replay_of(*courses, eta=2.0):
    rollouts = scene(*courses, adversaries=[1])
    rollouts.eta = torch.tensor([eta])
    return Replay(rollouts.rollout(0), score_rollouts(rollouts)[0][0], 60.0, SIDE)


def test_panels_stand_by_eta_at_their_contacts_and_without_one_at_the_first_of_the_stronger():
    replays = [replay_of(EGO, course(x, 0, 0, 5), eta=eta) for eta, x in ((0.0, 70), (1.0, 35), (3.0, 20))]
    figure = drawing.image_of(intensity_figure([Failure(each.rollout, each.row) for each in replays]))
    assert figure.size == (2 * SIDE + GAP, 2 * SIDE + GAP)
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
def shown():
    """Vehicle 2 acts on 1, which acts on the ego; 3 stands aside and is a candidate that was not taken."""
    rollout = replay_of(EGO, AHEAD, FAR, ASIDE).rollout
    settings = TopologySettings()
    reference = torch.as_tensor(rollout.states[:50:5])[None]
    size = torch.as_tensor(rollout.size)[None, None].expand(*reference.shape[:3], 2)
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


# --- files


def figure():
    made, axes = new_panels(2, 200, 10, 40, 30)
    axes[0].plot([0, 1, 2], [0, 1, 0], linewidth=2)
    axes[1].set_title("collisions η, ± 95%")
    add_legend(made, {"ego": "#1565d8"}, 10)
    return made


def test_a_figure_is_written_as_pixels_and_as_vectors_with_its_fonts(tmp_path):
    save_figure(tmp_path / "x.png", figure())
    with Image.open(tmp_path / "x.png") as picture:
        assert picture.size == (410, 270)
    content = (tmp_path / "x.pdf").read_bytes()
    assert content.startswith(b"%PDF") and b"/FontFile2" in content and b"/Subtype /Image" not in content
    assert re.search(rb"/MediaBox \[ 0 0 410 270 \]", content), "a point is a point"
    drawn = b"".join(
        zlib.decompress(part) for part in re.findall(rb"stream\r?\n(x.*?)\r?\nendstream", content, re.DOTALL)
    )
    assert re.search(rb"\d m\n.*\d l\n.*S\n", drawn, re.DOTALL), "lines, not pixels"


def test_the_same_figure_makes_the_same_bytes(tmp_path):
    for name in "ab":
        save_figure(tmp_path / f"{name}.png", figure())
    for suffix in ("png", "pdf"):
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()
    assert b"Date" not in (tmp_path / "a.pdf").read_bytes()


def test_layouts_that_are_made_on_drawing_fit_both(tmp_path):
    made, axes = plain_figure(300, 200, 1)
    axes[0].bar([0, 1], [1, 2])
    axes[0].set_ylabel("failures [%]")
    save_figure(tmp_path / "x.png", made)
    assert re.search(rb"/MediaBox \[ 0 0 300 200 \]", (tmp_path / "x.pdf").read_bytes())
