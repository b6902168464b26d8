"""Replays: the right failures, the contact where it is, animations that play, one line for bad input."""

import numpy as np
import pytest
from PIL import Image

from e2rl.evaluation.rollout_files import Source, label_rows, write_rollouts, write_rows
from e2rl.metrics.score import score_rollouts
from e2rl.report import drawing, picture
from e2rl.report import videos as replay
from e2rl.report.drawing import TrafficMap, image_of, new_panels
from tests.metrics.random_rollouts import random_rollouts
from tests.metrics.test_contact import course, scene
from tests.report.pixels import pixel_at, rgb


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run's folder: four rollouts of a method and one hit of `nominal`."""
    folder = tmp_path_factory.mktemp("run")
    rows = []
    for method, seed in (("nominal", 20), ("e2", 21)):
        rollouts = random_rollouts(6, seed=seed)
        rollouts["scene_id"] = [f"{name}_{index}" for index, name in enumerate(rollouts["scene_id"])]
        source = Source("synthetic", "test", method, "idm")
        write_rollouts(folder / "rollouts", rollouts, source)
        rows += label_rows(score_rollouts(rollouts)[0], source)
    write_rows(folder / "rollouts.csv", rows)
    return folder


def row(scene_id, eta=2.0, cfr=1.0, cfr_adv=1.0, kind="front"):
    return {"scene_id": scene_id, "eta": eta, "cfr": cfr, "cfr_adv": cfr_adv, "contact_type": kind}


def test_failures_are_distinct_found_and_of_different_kinds():
    rows = [
        row("a", eta=0.0),
        row("b"),
        row("b", kind="rear"),
        row("c", cfr=0.0),
        row("d"),
        row("e", kind="side", cfr_adv=0.0),
        row("f"),
    ]
    chosen = replay.found_failures(rows, 3)
    assert [part["scene_id"] for part in chosen] == ["b", "e", "d"]
    assert [part["scene_id"] for part in replay.found_failures(rows, 9)] == ["b", "e", "d", "f", "a"]
    assert replay.found_failures([row("c", cfr=0.0), row("n", cfr=float("nan"))], 3) == []


def test_the_command_saves_animations_and_strips_of_a_run_s_failures(run, capsys):
    assert replay.main([str(run), "--failures", "1", "--pixels", "240"]) == 0
    gif, png = capsys.readouterr().out.split()
    with Image.open(gif) as animation:
        assert animation.size == (240, 240) and animation.n_frames > picture.FREEZE and animation.info["loop"] == 0
        assert animation.info["duration"] == 100
    with Image.open(png) as strip:
        assert strip.size[0] > 3.9 * strip.size[1] * 0.9
    assert gif.split("/")[-1].startswith("e2__idm__2__")


def test_bad_input_is_one_line_and_exit_two(tmp_path, run, capsys):
    assert replay.main([str(tmp_path)]) == 2
    (tmp_path / "text.npz").write_text("no archive")
    assert replay.main([str(tmp_path / "text.npz")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 2 and all(line.startswith("error: ") for line in lines) and "text.npz" in lines[1]


def replay_of(tmp_path, *courses, **options):
    path = write_rollouts(tmp_path, scene(*courses, **options), Source("s", "t", "e2", "idm"))[0]
    return replay.load_replay(path, pixels=200)


def test_frames_end_with_the_contact_held_and_marked(tmp_path):
    shown = replay_of(tmp_path, course(0, 0, 0, 12), course(30.5, 0, 0, 5), adversaries=[1])
    assert shown.contact == 37
    frames = shown.frames()
    slow = round(picture.SLOW / 0.1)
    assert len(frames) == 37 - slow + 2 * slow + picture.FREEZE
    np.testing.assert_allclose(
        picture.contact_point(shown.rollout, 37, 1), [0.5 * (37 * 1.2 + 2.4 + 30.5 + 37 * 0.5 - 2.4), 0], atol=0.3
    )


def test_a_rollout_without_contact_plays_to_its_end(tmp_path):
    shown = replay_of(tmp_path, course(0, 0, 0, 5), course(0, 10, 0, 5))
    assert shown.contact is None and len(shown.frames()) == 81 and image_of(shown.strip()).size[1] > 200


def test_the_ego_is_blue_and_the_adversary_red_where_they_are(tmp_path):
    shown = replay_of(tmp_path, course(0, 0, 0, 0), course(12, 0, 0, 0), course(-12, 0, 0, 0), adversaries=[1])
    image = shown.picture(10)
    for x, colour in ((0, drawing.EGO), (12, drawing.ADVERSARY), (-12, drawing.BACKGROUND)):
        assert pixel_at(image, shown.panel.map.axes, np.array([x - 0.8, 0.0])) == rgb(colour)


def test_a_picture_is_the_same_after_the_panel_showed_another_moment(tmp_path):
    shown = replay_of(tmp_path, course(0, 0, 0, 12), course(30.5, 0, 0, 5), adversaries=[1])
    first = shown.picture(5).tobytes()
    assert shown.picture(37, phase=0.5).tobytes() != first == shown.picture(5).tobytes()


def test_y_is_up_and_the_centre_is_the_middle(tmp_path):
    shown = replay_of(tmp_path, course(0, 0, 0, 0))
    _, (axes,) = new_panels(1, 700, 0, 0)
    TrafficMap(axes, shown.rollout, 70.0).show(np.array([10.0, 20.0]), [], [])
    middle, above, right = axes.transData.transform([(10.0, 20.0), (10.0, 25.0), (15.0, 20.0)])
    np.testing.assert_allclose([middle, above, right], [(350, 350), (350, 400), (400, 350)])


def test_a_lane_beside_the_map_shows_as_far_as_it_is_wide(tmp_path):
    shown = replay_of(tmp_path, course(0, 0, 0, 0))
    figure, (axes,) = new_panels(1, 700, 0, 0)
    TrafficMap(axes, shown.rollout, 70.0).show(np.array([0.0, 36.0]), [], [])  # a lane 4 m wide at y = 0, 1 m below
    image = image_of(figure)
    assert pixel_at(image, axes, np.array([0.0, 1.3])) == rgb(drawing.ROAD)
    assert pixel_at(image, axes, np.array([0.0, 4.0])) == rgb(drawing.GROUND)


def test_the_camera_glides_along_the_ego_s_way():
    path = np.stack([np.linspace(0, 100, 81), np.zeros(81)], -1)
    np.testing.assert_allclose(picture.camera_path(path), path, atol=1e-6)
    assert picture.camera_path(path[:5]).shape == (5, 2)
