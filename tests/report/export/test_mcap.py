"""MCAP: the format's own reader gets back every state, the map and the facts."""

from collections import defaultdict
from dataclasses import replace
from io import BytesIO
from math import atan2

import numpy as np
import pytest

pytest.importorskip("mcap_protobuf", reason="--to mcap needs the extra mcap")
pytest.importorskip(
    "foxglove_schemas_protobuf", reason="--to mcap needs the extra mcap"
)
from mcap.reader import make_reader  # noqa: E402
from mcap_protobuf.decoder import DecoderFactory  # noqa: E402

from e2rl.evaluation.rollout_files import TABLE, read_rows
from e2rl.report.export.episode import rollout_episode
from e2rl.report.export.mcap import content
from tests.report.export.small_run import CUT_IN, LATE, exported, rollout_of  # noqa: E402


def read(path):
    """{topic: [(seconds, message)]} of a file."""
    found = defaultdict(list)
    reader = make_reader(
        BytesIO(path.read_bytes()), decoder_factories=[DecoderFactory()]
    )
    for _, channel, message, decoded in reader.iter_decoded_messages():
        found[channel.topic].append((message.log_time / 1e9, decoded))
    return found


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """The content of the files of all rollouts, in their order."""
    return [
        read(path)
        for path in exported(run, tmp_path_factory.mktemp("mcap") / "out", "mcap")
    ]


def boxes(update):
    """{row: (x, y, heading, length, width, entity)} of the agents of a message."""
    agents = {}
    for entity in update.entities:
        if entity.id.startswith("agent "):
            (cube,) = entity.cubes
            turn = cube.pose.orientation
            heading = 2 * atan2(turn.z, turn.w)
            place = cube.pose.position
            agents[int(entity.id.split()[1])] = (
                place.x,
                place.y,
                heading,
                cube.size.x,
                cube.size.y,
                entity,
            )
    return agents


def test_every_state_of_everybody_who_is_there_comes_back(run, written):
    for scene, topics in enumerate(written):
        rollout = rollout_of(run, scene)
        assert len(topics["/traffic"]) == len(topics["/tf"]) == len(rollout.states)
        for step, (time, update) in enumerate(topics["/traffic"]):
            agents = boxes(update)
            assert time == pytest.approx(0.1 * step)
            assert update.entities[0].timestamp.ToSeconds() == int(time)
            assert sorted(agents) == np.flatnonzero(rollout.valid[step]).tolist()
            for row, (*place, heading, length, width, _) in agents.items():
                x, y, turned, _ = rollout.states[step, row]
                assert place == pytest.approx([x, y], abs=1e-5)
                assert abs((heading - turned + np.pi) % (2 * np.pi) - np.pi) < 1e-5
                assert [length, width] == pytest.approx(rollout.size[row].tolist())
            assert [deleted.type for deleted in update.deletions] == [1], (
                "each message replaces the one before"
            )
            frame = topics["/tf"][step][1]
            assert [frame.translation.x, frame.translation.y] == pytest.approx(
                rollout.states[step, 0, :2], abs=1e-5
            )
        assert any(LATE not in boxes(update) for _, update in topics["/traffic"])


def test_the_map_lights_and_contact(run, written):
    topics = written[0]
    ((time, update),) = topics["/map"]
    rollout = rollout_of(run, 0)
    ends = np.array(
        [(point.x, point.y) for point in update.entities[0].lines[0].points]
    ).reshape(-1, 2, 2)
    assert time == 0
    assert len(ends) == len(rollout.lane_points) - (len(rollout.lane_offsets) - 1)
    assert np.abs(ends[0] - rollout.lane_points[:2]).max() < 1e-5
    lights = [
        entity for entity in topics["/traffic"][0][1].entities if entity.id == "lights"
    ]
    assert len(lights[0].spheres) == 2
    assert lights[0].spheres[0].color != lights[0].spheres[1].color
    row = read_rows(run / TABLE)[0]
    contacts = [
        time
        for time, update in topics["/traffic"]
        if any(part.id == "contact" for part in update.entities)
    ]
    assert contacts == [pytest.approx(0.1 * row["contact_step"])]


def test_plans_are_there_where_the_rollout_has_them_and_the_same_rollout_makes_the_same_file(
    run, tmp_path
):
    episode = rollout_episode(run, read_rows(run / TABLE)[0])
    plans = np.cumsum(np.ones((3, 2, 10, 2), np.float32), 2)
    plans[2, 1] = np.nan
    planned = replace(
        episode,
        rollout=replace(episode.rollout, plans=plans, planners=np.array([0, CUT_IN])),
    )
    (tmp_path / "x.mcap").write_bytes(content(planned))
    topics = read(tmp_path / "x.mcap")
    assert [round(time, 6) for time, _ in topics["/plans"]] == [0.0, 0.5, 1.0]
    assert [len(update.entities) for _, update in topics["/plans"]] == [2, 2, 1]
    assert content(episode) == content(episode)
