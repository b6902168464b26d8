"""MCAP: the format's own reader, with the schemas that the file holds, gets back what
was driven, to the nanosecond and, but for headings, to the last bit."""

import json
from functools import cache

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="--to mcap needs the extra mcap")
pytest.importorskip("mcap", reason="the independent reader")
from google.protobuf.descriptor_pb2 import FileDescriptorSet  # noqa: E402
from google.protobuf.descriptor_pool import DescriptorPool  # noqa: E402
from google.protobuf.message_factory import GetMessageClass  # noqa: E402
from mcap.reader import make_reader  # noqa: E402

from e2rl.report.export.mcap_writer import ALL, FRAME, LAYOUT  # noqa: E402
from tests.report.export.bundled_run import failure_of, gaps  # noqa: E402
from tests.report.export.small_run import exported  # noqa: E402

STEP = 10**8  # ns
OTHERS = {"driver", "evasion", "recorded"}


@cache
def message_class(name: str, schema: bytes):
    """The class of the message that a schema of a file describes."""
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(name))


def no_json(word: str):
    raise ValueError(f"{word} is no JSON")


def decoded(schema, channel, message):
    if channel.message_encoding == "json":
        return json.loads(message.data, parse_constant=no_json)
    return message_class(schema.name, schema.data).FromString(message.data)


@pytest.fixture(scope="module")
def folder(bundled, tmp_path_factory):
    out = tmp_path_factory.mktemp("mcap") / "out"
    exported(bundled, out, "mcap", "--no-scene")
    return out


def messages_of(path):
    """{topic: [(log time [ns], message)]} of a file"""
    topics = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            entry = message.log_time, decoded(schema, channel, message)
            topics.setdefault(channel.topic, []).append(entry)
    return topics


@pytest.fixture(scope="module")
def messages(folder):
    (path,) = folder.glob("*.mcap")
    return messages_of(path)


@pytest.fixture(scope="module")
def failure(bundled):
    return failure_of(bundled)


def nanoseconds(timestamp) -> int:
    return timestamp.seconds * 10**9 + timestamp.nanos


def heading_of(rotation) -> float:
    assert rotation.x == rotation.y == 0
    return 2 * np.arctan2(rotation.z, rotation.w)


def row_of(name: str) -> int:
    return 0 if name == "Ego" else int(name.removeprefix("agent_"))


def test_a_step_is_a_tenth_of_a_second_in_header_and_log(messages, failure):
    expected = [STEP * step for step in range(len(failure.rollout.states))]
    for topic in ("/traffic", "/alternatives", "/motion", "/tf"):
        assert [time for time, _ in messages[topic]] == expected
    for time, message in messages["/traffic"]:
        assert {nanoseconds(entity.timestamp) for entity in message.entities} == {time}
    assert [
        nanoseconds(message.timestamp) for _, message in messages["/tf"]
    ] == expected


def test_boxes_are_those_of_the_rollout_and_of_nobody_else(messages, failure):
    rollout = failure.rollout
    for step, (_, message) in enumerate(messages["/traffic"]):
        rows = [row_of(entity.id) for entity in message.entities]
        assert rows == np.flatnonzero(rollout.valid[step]).tolist()
        for row, entity in zip(rows, message.entities, strict=True):
            (cube,) = entity.cubes
            x, y, heading, _ = rollout.states[step, row].tolist()
            size = cube.size
            place = cube.pose.position
            assert (place.x, place.y, place.z) == (x, y, size.z / 2)
            assert [size.x, size.y] == rollout.size[row].tolist()
            turn = heading_of(cube.pose.orientation) - heading
            assert abs(np.sin(turn / 2)) < 1e-12
            assert entity.frame_id == FRAME


def test_roles_say_who_drives(messages, failure):
    (_, message) = messages["/traffic"][0]
    roles = {entity.id: entity.metadata[0].value for entity in message.entities}
    assert roles.pop("Ego") == "ego"
    adversary = f"agent_{failure.partner}"
    assert [name for name, role in roles.items() if role == "adversary"] == [adversary]


def test_a_message_is_the_whole_picture_of_its_time(messages):
    """A player that seeks reads the latest message of each topic, and no other."""
    for topic in ("/map", "/traffic", "/alternatives", "/plans"):
        for time, message in messages[topic]:
            (deletion,) = message.deletions
            assert deletion.type == int(ALL)
            assert nanoseconds(deletion.timestamp) == time


def test_the_frame_of_the_ego_is_in_its_box(messages, failure):
    for (_, message), state in zip(
        messages["/tf"], failure.rollout.states[:, 0], strict=True
    ):
        assert (message.parent_frame_id, message.child_frame_id) == (FRAME, "Ego")
        assert [message.translation.x, message.translation.y] == state[:2].tolist()
        assert abs(np.sin((heading_of(message.rotation) - state[2]) / 2)) < 1e-7


def test_speeds_and_gaps_are_those_of_the_boxes(messages, failure):
    rollout = failure.rollout
    values = [message for _, message in messages["/motion"]]
    speeds = [value["partner"]["speed"] for value in values]
    assert speeds == rollout.states[:, failure.partner, 3].tolist()
    for name, states in (
        ("Ego", rollout.states[:, 0]),
        ("driver", rollout.driver),
        ("evasion", rollout.evasion),
        ("recorded", rollout.logged[:, 0]),
    ):
        gap = [value[name]["gap"] for value in values]
        expected = gaps(rollout, states, failure.partner)
        np.testing.assert_allclose(gap, expected, atol=1e-5)
    assert values[failure.contact]["Ego"]["gap"] == 0 < values[0]["Ego"]["gap"]
    assert set(values[0]) > OTHERS
    for step, value in enumerate(values):
        present = {
            row_of(name) for name in set(value) - OTHERS - {"partner"} if value[name]
        }
        assert present == set(np.flatnonzero(rollout.valid[step]).tolist())


def test_without_a_contact_nobody_has_a_gap(run, tmp_path):
    _, path = exported(run, tmp_path / "out", "mcap")
    messages = messages_of(path)
    assert "partner" not in messages["/verdict"][0][1]
    for _, values in messages["/motion"]:
        assert all(set(series) <= {"speed"} for series in values.values())


def test_the_verdict_is_that_of_the_table(messages, failure):
    ((time, facts),) = messages["/verdict"]
    assert time == 0
    for name in ("scene_id", "contact_step", "contact_type", "duty", "preventable"):
        assert facts[name] == failure.row[name]
    assert facts["adversaries"] == [failure.partner]


def points_of(line) -> list[list[float]]:
    return [[point.x, point.y] for point in line.points]


def test_lines_are_those_of_the_map(messages, failure):
    ((_, message),) = messages["/map"]
    (entity,) = message.entities
    lines = [points_of(line) for line in entity.lines]
    rings = [ring.tolist() for ring in failure.rollout.polygons()]
    lanes = [lane.tolist() for lane in failure.rollout.lanes()]
    assert lines == [ring + ring[:1] for ring in rings] + lanes


def test_plans_are_those_of_the_ego_and_the_adversary(messages, failure):
    rollout = failure.rollout
    assert [time for time, _ in messages["/plans"]] == [
        5 * STEP * number for number in range(len(rollout.plans))
    ]
    for (_, message), plans in zip(messages["/plans"], rollout.plans, strict=True):
        names = [entity.id for entity in message.entities]
        assert names == ["Ego", f"agent_{failure.partner}"]
        lines = [points_of(entity.lines[0]) for entity in message.entities]
        assert lines == plans.tolist()


def test_the_layout_names_what_files_hold(folder, messages):
    layout = json.loads((folder / LAYOUT).read_text())
    panels = layout["configById"]
    assert set(panels["3D!scene"]["topics"]) < set(messages)
    assert panels["RawMessages!verdict"]["topicPath"] in messages
    for panel in ("Plot!speed", "Plot!gap"):
        for path in panels[panel]["paths"]:
            topic, name, series = path["value"].split(".")
            assert series in messages[topic][0][1][name]


def test_the_same_failure_makes_the_same_file(bundled, folder, tmp_path):
    exported(bundled, tmp_path / "again", "mcap", "--no-scene")
    for path in folder.iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()
