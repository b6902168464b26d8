"""A round's videos show attacks that hit the ego, one of a scene, and land on the dashboard."""

import pytest
import torch
from e2rl.scripts.train import train_round
from PIL import Image

from e2rl.learning.logging import RunLogger
from e2rl.learning.schedules import AdaptiveCurriculum
from e2rl.metrics.contact import first_contact
from e2rl.report.rounds import hits, replay_of, round_line, save_videos
from tests.learning.small import small_run, small_scenes


@pytest.fixture(scope="module")
def attacked():
    scenes = small_scenes()
    run = small_run(scenes=scenes)
    run.curriculum = AdaptiveCurriculum(len(scenes), 4, eta=4.0, spread=0.0)  # 8 m ahead and half as fast
    return scenes, run, train_round(run)


def test_videos_are_of_hits_of_different_scenes(attacked):
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
    assert replay.contact == int(first["stop"]), "a video ends with the contact"


def test_videos_are_written_and_move_on_the_dashboard_too(attacked, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    scenes, run, metrics = attacked
    logger, traffic = RunLogger("tensorboard", tmp_path), run.memory.rounds[-1].traffic
    logger.log(metrics, 0, run.choices)
    assert not list(save_videos(traffic, scenes, 1, "brake_check", tmp_path, 0))
    (video,) = save_videos(traffic, scenes, 1, "brake_check", tmp_path, 1)
    logger.show("synthesizer/video_1", video, 0)
    logger.close()
    assert video == tmp_path / "videos" / "round-001-1.gif" and Image.open(video).n_frames > 10
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert events.Images("synthesizer/video_1")[0].encoded_image_string == video.read_bytes()
    assert events.Scalars("synthesizer/eta")[0].value == pytest.approx(metrics["synthesizer/eta"])


def test_a_line_says_what_is_known(attacked):
    metrics = attacked[2] | {"synthesizer/contact": 0.25, "synthesizer/left_out": 2.0, "time/improve": 7.4}
    line = round_line(metrics, 1, 4)
    assert line == "round 1/4: the attacks hit in 25% of 3 scenes, 2 left out (eta 4.00); 7 s learning"
    errored = round_line(metrics | {"synthesizer/errored_raised_KeyError": 1.0}, 1, 4)
    assert errored == line + ", without a score: 1 raised KeyError"
