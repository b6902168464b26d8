"""A round's films show attacks that hit the ego, one of a scene, and land on the dashboard beside the choices."""

import pytest
import torch
from PIL import Image

from e2rl.learning.logging import RunLogger
from e2rl.learning.schedules import AdaptiveCurriculum
from e2rl.metrics.contact import first_contact
from e2rl.report.rounds import draw_round, hits, replay_of, round_line
from tests.learning.small import small_run, small_scenes


@pytest.fixture(scope="module")
def attacked():
    scenes = small_scenes()
    run = small_run(scenes=scenes)
    run.curriculum = AdaptiveCurriculum(len(scenes), 4, eta=4.0, spread=0.0)  # 8 m ahead and half as fast
    return scenes, run, run.run_round()


def test_films_are_of_hits_of_different_scenes(attacked):
    scenes, run, _ = attacked
    traffic = run.memory.rounds[-1].traffic
    rows = hits(traffic, scenes)
    assert len(rows) and len(set(traffic["scene_index"][rows].tolist())) == len(rows)
    assert (traffic["eta"][rows] > 0).all()
    twice = {name: torch.cat([value, value]) for name, value in traffic.items() if value.dim()}
    assert hits(twice, scenes).tolist() == rows.tolist(), "a scene is shown once"
    replay = replay_of(traffic, int(rows[0]), scenes, "brake_check")
    scene = scenes.batch(traffic["scene_index"][rows[:1]])
    tracks = {name: traffic[name][rows[:1]] for name in ("states", "valid")}
    first = first_contact(tracks | {name: scene[name] for name in ("size", "agent_type")})
    assert replay.contact == int(first["stop"]), "a film ends with the contact"


def test_a_round_is_drawn_and_logged(attacked, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    scenes, run, metrics = attacked
    logger = RunLogger("tensorboard", tmp_path)
    logger.log(metrics, 0, run.choices)
    draw_round(run, scenes, "brake_check", tmp_path, logger, replays=1)
    logger.close()
    (film,) = (tmp_path / "replays").glob("*.gif")
    assert film.name == "round-001-1.gif" and Image.open(film).n_frames > 10
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert {"curriculum/choices", "synthesizer/replay_1"} == set(events.Tags()["images"])
    assert events.Images("synthesizer/replay_1")[0].encoded_image_string == film.read_bytes(), "it moves there, too"
    assert events.Scalars("synthesizer/eta")[0].value == pytest.approx(metrics["synthesizer/eta"])


def test_no_films_without_being_asked(attacked, tmp_path):
    scenes, run, _ = attacked
    draw_round(run, scenes, "brake_check", tmp_path, RunLogger("none", tmp_path), replays=0)
    assert not list(tmp_path.iterdir())


def test_a_line_says_what_is_known(attacked):
    line = round_line(attacked[2], 1, 4)
    assert line.startswith("round 1/4: eta 4.00") and "waiting" not in line, "nothing was made beside learning"
