"""The figure of intensities: what stands where in pixels of the image; PNG and
PDF files."""

import math

import numpy as np
import torch

from e2rl.metrics.score import score_rollouts
from e2rl.report import drawing
from e2rl.report.drawing import new_figure, save_figure
from e2rl.report.picture import SIDE, Replay, best_sweep, intensity_figure, worth
from e2rl.report.picture import SWEEP_GAP as GAP
from e2rl.sim.rollout_file import Failure
from tests.metrics.test_contact import course, scene

EGO = course(0, 0, heading=0, speed=10)
AHEAD = course(25, 0, heading=0, speed=6)
FAR = course(50, 0, heading=0, speed=4)
ASIDE = course(0, 25, heading=1.0, speed=0)


def replay_of(*courses, eta=2.0):
    rollouts = scene(*courses, adversaries=[1])
    rollouts.eta = torch.tensor([eta])
    return Replay(
        rollouts.rollout(0), score_rollouts(rollouts)[0][0], metres=60.0, pixels=SIDE
    )


def test_panels_stand_by_eta_at_their_contacts_and_without_one_at_the_first_of_the_stronger():
    replays = [
        replay_of(EGO, course(x, 0, heading=0, speed=5), eta=eta)
        for eta, x in ((0.0, 70), (1.0, 35), (3.0, 20))
    ]
    figure = drawing.image_of(
        intensity_figure([Failure(each.rollout, each.row) for each in replays])
    )
    assert replays[0].contact is None
    assert replays[1].contact > replays[2].contact
    times = [replays[1].contact, replays[1].contact, replays[2].contact]
    for index, (time, phase) in enumerate(zip(times, (None, 0.25, 0.25), strict=True)):
        left = (index % 2) * (SIDE + GAP)
        top = (index // 2) * (SIDE + GAP)
        panel = np.asarray(figure.crop((left, top, left + SIDE, top + SIDE)))
        different = (
            panel != np.asarray(replays[index].picture(time, phase=phase))
        ).any(-1)
        assert different.mean() < 1e-4, (
            "where a panel stands changes the rounding of its edges"
        )


def test_the_same_figure_is_written_as_the_same_pixels_and_vectors_and_no_name_is_a_formula(
    tmp_path,
):
    for name in "ab":
        made = new_figure(410, 270)
        axes = made.subplots(1, 2)
        axes[0].plot([0, 1, 2], [0, 1, 0], linewidth=2)
        axes[0].set_title("$\\frac{")
        save_figure(tmp_path / f"{name}.png", made)
    for suffix in ("png", "pdf"):
        assert (tmp_path / f"a.{suffix}").read_bytes() == (
            tmp_path / f"b.{suffix}"
        ).read_bytes()
    content = (tmp_path / "a.pdf").read_bytes()
    assert b"/MediaBox [ 0 0 410 270 ]" in content
    assert b"/Subtype /Image" not in content, "a point is a point"


def test_the_shown_sweep_is_unharmed_at_first_and_then_hit_ever_earlier():
    def sweep(*times, scene="a"):
        same = {"method": "e2", "ego_policy": "idm", "scene_id": scene, "seed": 0}
        rows = [
            {"eta": eta, "cfr": time == time, "contact_time": time}
            for eta, time in enumerate(times)
        ]
        return [same | {"min_dtc": 1.0 + row["eta"]} | row for row in rows]

    none = math.nan
    times = [
        (3.0, 2.0, 1.0),
        (none, 3.0, none),
        (none, none, none),
        (none, none, 2.0),
        (none, 2.0, 2.5),
    ]
    order = [sweep(*each) for each in (*times, (none, 2.5, 2.4), (none, 3.5, 2.4))]
    assert sorted(order, key=worth) == order
    rows = [
        *sweep(none, 4.0, 3.0),
        *sweep(none, 4.0, 1.0, scene="b"),
        *sweep(none, 4.0, scene="c"),
    ]
    assert best_sweep(rows[::-1]) == rows[3:6]
