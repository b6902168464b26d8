"""Videos: the right failures, the contact where it is, animations that play, one line
for bad input."""

import numpy as np
import pytest
from PIL import Image

from e2rl.commands.replay import main
from e2rl.metrics.score import score_rollouts
from e2rl.report import drawing, picture
from e2rl.report.picture import Replay
from e2rl.report.videos import found_failures, save_animation
from e2rl.run.errors import InputError
from tests.metrics.random_rollouts import random_rollouts
from tests.metrics.test_contact import course, scene
from tests.report.failed_run import write_run
from tests.report.pixels import pixel_at, rgb

CRASH = course(0, 0, heading=0, speed=12), course(30.5, 0, heading=0, speed=5)


def replay_of(*courses, **options):
    rollouts = scene(*courses, **options)
    return Replay(rollouts.rollout(0), score_rollouts(rollouts)[0][0], pixels=200)


def row(scene_id, eta=2.0, cfr=1.0, cfr_adv=1.0, kind="front", counted=0.0):
    return {
        **{
            "scene_id": scene_id,
            "eta": eta,
            "cfr": cfr,
            "cfr_adv": cfr_adv,
            "contact_type": kind,
        },
        "counted": counted,
    }


def test_failures_are_distinct_found_and_of_different_kinds():
    rows = [
        row("a", eta=0.0),
        row("b"),
        row("b", kind="rear"),
        row("c", cfr=0.0),
        row("d"),
    ]
    rows += [row("e", kind="side", cfr_adv=0.0), row("f")]
    assert [part["scene_id"] for part in found_failures(rows, 3)] == ["b", "e", "d"]
    assert [part["scene_id"] for part in found_failures(rows, 9)] == [
        "b",
        "e",
        "d",
        "f",
        "a",
    ]
    assert [
        part["scene_id"] for part in found_failures([*rows, row("g", counted=1.0)], 1)
    ] == ["g"]
    assert found_failures([row("c", cfr=0.0), row("n", cfr=float("nan"))], 3) == []


def test_the_command_saves_animations_of_a_run_s_failures(tmp_path, capsys):
    run = write_run(tmp_path / "run", {"e2": random_rollouts(6, seed=21)})
    main([str(run), "--failures=1", "--pixels", "120", "--out", str(tmp_path)])
    (gif,) = capsys.readouterr().out.splitlines()
    with Image.open(gif) as animation:
        assert animation.size == (120, 120)
        assert animation.n_frames > picture.FREEZE
        assert animation.info["loop"] == 0
        assert animation.info["duration"] == 100


def test_the_contact_is_marked_where_the_boxes_touch():
    shown = replay_of(*CRASH, adversaries=[1])
    assert shown.contact == 37
    middle = 0.5 * (37 * 1.2 + 2.4 + 30.5 + 37 * 0.5 - 2.4)
    np.testing.assert_allclose(
        picture.contact_point(shown.rollout, 37, partner=1), [middle, 0], atol=0.3
    )


def test_the_ego_is_blue_and_the_adversary_red_where_they_are():
    shown = replay_of(
        course(0, 0, heading=0, speed=0),
        course(12, 0, heading=0, speed=0),
        course(-12, 0, heading=0, speed=0),
        adversaries=[1],
    )
    image = shown.picture(10)
    for x, colour in (
        (0, drawing.EGO),
        (12, drawing.ADVERSARY),
        (-12, drawing.BACKGROUND),
    ):
        assert pixel_at(
            image, shown.panel.map.axes, point=np.array([x - 0.8, 0.0])
        ) == rgb(colour)


def test_another_kind_is_told_before_anything_is_drawn(tmp_path):
    frames = (pytest.fail("drawn for nothing") for _ in range(1))
    with pytest.raises(InputError, match="failure.avi: .*gif"):
        save_animation(tmp_path / "failure.avi", frames)
