"""A round's videos show attacks that hit the ego, one of a scene."""

import pytest
import torch
from e2rl.scripts.train import train_round
from PIL import Image

from e2rl.learning.rounds.schedules import AdaptiveCurriculum
from e2rl.report.rounds import hits, save_videos
from tests.learning.small import small_run, small_scenes


@pytest.fixture(scope="module")
def attacked():
    scenes = small_scenes()
    run = small_run(scenes=scenes)
    run.curriculum = AdaptiveCurriculum(
        len(scenes), 4, eta=4.0, spread=0.0
    )  # 8 m ahead and half as fast
    return scenes, run, train_round(run)


def test_videos_are_of_hits_of_different_scenes(attacked):
    scenes, run, _ = attacked
    traffic = run.memory.rounds[-1].traffic
    rows = hits(traffic, scenes)
    assert len(rows)
    assert len(set(traffic["scene_index"][rows].tolist())) == len(rows)
    assert (traffic["eta"][rows] > 0).all()
    twice = {
        name: torch.cat([value, value])
        for name, value in traffic.items()
        if value.dim()
    }
    assert hits(twice, scenes).tolist() == rows.tolist(), "a scene is shown once"


def test_videos_are_written(attacked, tmp_path):
    scenes, run, _ = attacked
    (video,) = save_videos(
        run.memory.rounds[-1].traffic,
        scenes,
        number=1,
        method="brake_check",
        folder=tmp_path,
        count=1,
    )
    assert video == tmp_path / "videos" / "round-001-1.gif"
    assert Image.open(video).n_frames > 10
