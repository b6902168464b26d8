"""SUMO plays exported failures, and its own runs are read as it drove them."""

import os
import subprocess
from xml.etree import ElementTree

import numpy as np
import pytest

pytest.importorskip("sumolib", reason="SUMO's files need the extra sumo")
pytest.importorskip("scenariogeneration", reason="--to sumo needs the extra sumo")
from e2rl.evaluation.rollout_files import TABLE, read_rows  # noqa: E402
from e2rl.report.export.scene_files import episodes_of  # noqa: E402
from e2rl.report.export.sumo_writer import write  # noqa: E402
from e2rl.scenes.paths import arc_length, direction  # noqa: E402
from e2rl.scenes.sumo import SumoSource  # noqa: E402
from tests.report.export.clients.environment import environment  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.clients]
PLACE = 1e-3  # m and degrees between what is played and the rollout
DRIVEN = 0.05  # m between a lane and who drives on it


@pytest.fixture(scope="module")
def sumo(tmp_path_factory):
    """Runs a program of SUMO."""
    folder = environment("sumo")
    (home,) = folder.glob("lib/python*/site-packages/sumo")

    def program(name: str, *arguments) -> None:
        subprocess.run(
            [folder / "bin" / name, *map(str, arguments)],
            check=True,
            capture_output=True,
            env={**os.environ, "SUMO_HOME": str(home)},
        )

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SUMO_HOME", str(home))
        yield program


def vehicles(path) -> dict:
    """By (step, id) what an FCD output says."""
    return {
        (round(10 * float(step.get("time"))), vehicle.get("id")): vehicle
        for step in ElementTree.parse(path).getroot()
        for vehicle in step
    }


@pytest.mark.parametrize(("fixture", "scene"), [("run", True), ("bundled", False)])
def test_sumo_plays_every_agent_at_every_step(fixture, scene, request, sumo, tmp_path):
    folder = request.getfixturevalue(fixture)
    episodes = episodes_of(folder, read_rows(folder / TABLE), plugins=[], scene=scene)
    count = 0
    for episode, path in write(episodes, tmp_path):
        played = tmp_path / "played.xml"
        sumo("sumo", "-c", path, "--fcd-output", played, "--precision", 6)
        result = vehicles(played)
        rollout = episode.rollout
        expected = {
            (step + 1, row) for step, row in np.argwhere(rollout.valid).tolist()
        }
        row_of = {episode.name(row): row for row in episode.agents}
        begins = {
            (first, row)
            for row in episode.agents
            for first, _ in episode.appearances(row)
        }
        steps = {(step, row_of[name.partition("#")[0]]) for step, name in result}
        assert steps == expected | begins
        for (step, name), vehicle in result.items():
            row = row_of[name.partition("#")[0]]
            if (step, row) in begins:  # outside of the map
                continue
            x, y, heading, _ = rollout.states[step - 1, row].tolist()
            front = np.array([x, y]) + rollout.size[row, 0] / 2 * direction(heading)
            place = [float(vehicle.get(part)) for part in "xy"]
            assert place == pytest.approx(front, abs=PLACE)
            turned = float(vehicle.get("angle")) - (90 - np.degrees(heading))
            assert abs((turned + 180) % 360 - 180) < PLACE
            count += 1
    assert count > 900


def test_who_drove_in_sumo_is_read_where_its_lane_is(sumo, tmp_path):
    net = tmp_path / "n.net.xml"
    routes = tmp_path / "t.rou.xml"
    sumo("netgenerate", "--grid", "--grid.number", 3, "--seed", 1, "-o", net)
    edges = ["A0A1", "A1B1", "B1B2", "B2C2"]
    kinds = '<vType id="car" length="4.3"/><vType id="bus" vClass="bus"/>'
    trips = "".join(
        f'<vehicle id="{number}" type="{kind}" depart="{2 * number}">'
        f'<route edges="{" ".join(edges)}"/></vehicle>'
        for number, kind in enumerate(["car", "bus", "car"])
    )
    routes.write_text(f"<routes>{kinds}{trips}</routes>")
    output = tmp_path / "fcd.xml"
    sumo(
        "sumo",
        "-n",
        net,
        "-r",
        routes,
        "--step-length",
        0.1,
        "--end",
        60,
        "--seed",
        1,
        "--fcd-output",
        output,
    )
    (recording,) = SumoSource(str(tmp_path)).read(output.name)
    assert recording.size.tolist() == [[4.3, 1.8], [12.0, 2.5], [4.3, 1.8]]
    driven = set()
    for (step, name), vehicle in vehicles(output).items():
        states = recording.states[step, int(name)]
        assert recording.valid[step, int(name)]
        front = states[:2] + recording.size[int(name), 0] / 2 * direction(states[2])
        lane = recording.lanes[vehicle.get("lane")]
        arc = arc_length(lane.points)
        at = [np.interp(float(vehicle.get("pos")), arc, part) for part in lane.points.T]
        assert front == pytest.approx(at, abs=DRIVEN)
        driven.add(vehicle.get("lane"))
    assert driven >= {f"{edge}_0" for edge in edges}
