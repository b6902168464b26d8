"""A planner in another process drives as the same law does inside, and what goes wrong
in a scene costs that scene."""

import json
import multiprocessing
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from functools import partial
from itertools import product
from pathlib import Path

import pytest
import torch

from e2rl import roll_out
from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.protocol import run_protocol
from e2rl.evaluation.rollout_files import ERRORED_FILE
from e2rl.planners.external import ExternalEgo
from e2rl.planners.planner_messages import plan_message, scene_messages
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.sim.mission import mission_of
from e2rl.sim.settings import SimSettings
from e2rl.sim.world import World
from e2rl.traffic.rule_based import LogReplay
from tests.planners.planners import SameLaw, command_of, wrong_planner
from tests.run.test_endings import alive
from tests.synthetic import make_scenes

# The scene in which planners of these tests go wrong: its ego is at y = 3.5, in all
# others at 0.
BAD = 2
ROAD = [(0.0, 0, 10.0), (25.0, 0, 6.0), (60.0, 1, 4.0)]
linux = pytest.mark.skipif(sys.platform != "linux", reason="asks /proc")


def scene_set(count=4, **about):
    """Scenes with a slow leader; the ego of scene BAD is in the other lane, on its
    route."""
    result = make_scenes(count, vehicles=ROAD, steps=12, **about)
    result.scenes["start"][BAD : BAD + 1, 0, 1] = 3.5
    result.scenes["logged"][BAD : BAD + 1, :, 0, 1] = 3.5
    result.scenes["route_points"][BAD : BAD + 1, 0, :, :, 1] = 3.5
    return result


def run(
    ego,
    folder=None,
    processes=1,
    batch=4,
):
    setup = Setup(
        scene_set(),
        ego,
        ego_name="external",
        sim=SimSettings(),
        batch=batch,
    )
    return run_protocol(
        setup,
        [Method("replay", LogReplay())],
        seeds=[0],
        folder=folder,
        processes=processes,
    )


@pytest.mark.parametrize(("replan_every", "red_light_x"), [(1, None), (5, 45.0)])
def test_it_drives_as_the_same_law_inside(replan_every, red_light_x):
    scenes = scene_set(red_light_x=red_light_x)
    inside, outside = (
        roll_out(scenes, ego, traffic=LogReplay()).states
        for ego in (
            SameLaw(replan_every),
            ExternalEgo(command_of(), replan_every=replan_every),
        )
    )
    assert torch.allclose(inside, outside, atol=1e-3)
    speed = outside[:, -1, 0, 3]
    behind = torch.arange(4) != BAD
    assert (speed[behind] < 9).all()
    assert (speed[BAD] > 10) == (red_light_x is None)


def test_one_that_runs_serves_several_connections():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    planner = subprocess.Popen([*command_of().split(), f"127.0.0.1:{port}"])
    try:
        (row,) = run(
            ExternalEgo(address=f"127.0.0.1:{port}"),
            processes=2,
            batch=2,
        )
        (inside,) = run(SameLaw())
    finally:
        planner.kill()
        planner.wait()
    assert row["metrics"]["progress"] == pytest.approx(
        inside["metrics"]["progress"],
        abs=1e-3,
        nan_ok=True,
    )
    assert row["n_rollouts"] == 4
    assert row["errored"] == {}


TRAJECTORY = "return reply(self, 4, scene + struct.pack('<I{0}f', {1}, *[{2}] * {0}))"
WRONGS = {
    "raises": (
        {"act": "raise ValueError('no way out')"},
        "PlannerFailed",
        "no way out",
    ),
    "dies": ({"act": "os._exit(3)"}, "PlannerDied", "ended with status 3"),
    "hangs": (
        {"act": "time.sleep(100)"},
        "PlannerTimedOut",
        "no reply within 0.3 s a scene",
    ),
    "NaN": ({"act": "return math.nan, 0"}, "BadReply", "an action that is not finite"),
    "jumps": ({"reply": TRAJECTORY.format(200, 50, 20.0)}, "BadReply", "jumps"),
    "short": (
        {"reply": TRAJECTORY.format(4, 1, 0.0)},
        "BadReply",
        "fewer than the 5 steps until the next plan",
    ),
    "long": (
        {"reply": "self.wfile.write(struct.pack('<2I', 4, 2**31))"},
        "BadReply",
        "announces 2147483648 bytes",
    ),
}


@pytest.mark.parametrize("name", WRONGS)
def test_what_goes_wrong_in_a_scene_costs_that_scene(tmp_path, name):
    wrong, reason, detail = WRONGS[name]
    ego = ExternalEgo(
        wrong_planner(tmp_path, 3.5, **wrong), timeout=0.3 if name == "hangs" else 5.0
    )
    (row,) = run(ego, tmp_path)
    (entry,) = json.loads((tmp_path / ERRORED_FILE).read_text())
    assert row["errored"] == {f"raised {reason}": 1}
    assert row["n_rollouts"] == 4
    assert entry["raised_by"] == "ego"
    assert row["metrics"]["errored"]["mean"] == 0.25
    assert entry["scene_id"] == scene_set().scene_id[BAD]
    assert re.search(detail, entry["detail"]), entry["detail"]


def test_it_is_restarted_as_often_as_allowed(tmp_path):
    command = wrong_planner(tmp_path, 3.5, act="os._exit(3)")
    (row,) = run(ExternalEgo(command, restarts=1))
    assert row["metrics"]["errored"]["mean"] == 0.25
    assert len(list((tmp_path / "marks").iterdir())) == 2
    (row,) = run(ExternalEgo(command, restarts=0), tmp_path)
    assert row["errored"] == {"raised PlannerDied": 4}
    assert row["metrics"]["errored"]["mean"] == 1.0
    details = [
        entry["detail"] for entry in json.loads((tmp_path / ERRORED_FILE).read_text())
    ]
    assert (
        sum(
            "it was restarted 0 times; see ego.restarts" in detail for detail in details
        )
        == 3
    )
    assert len(list((tmp_path / "marks").iterdir())) == 3


@linux
def test_its_process_ends_with_its_ego(tmp_path):
    ego = ExternalEgo(wrong_planner(tmp_path, 1e3))
    run(ego)
    (process,) = (int(mark.name) for mark in (tmp_path / "marks").iterdir())
    assert alive(process)
    del ego
    assert not alive(process)


def started_command(ego):
    """The process of a command with two workers, which a terminal's Ctrl-C reaches with
    all that it starts."""

    def command():
        os.setsid()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with ending(lambda: "do it again"):
            run(
                ego,
                processes=2,
                batch=2,
            )

    running = multiprocessing.get_context("fork").Process(target=command)
    running.start()
    return running


def pids_in(folder, count):
    """Numbers of the files in a folder, once there are so many; each is a process that
    lives."""
    begin = time.monotonic()
    while len(list(folder.iterdir())) < count and time.monotonic() - begin < 30:
        time.sleep(0.02)
    pids = [int(mark.name) for mark in folder.iterdir()]
    assert len(pids) == count
    assert all(map(alive, pids))
    time.sleep(0.2)
    return pids


def alive_after(pids, seconds):
    """Whether any of these processes still lives, so many seconds from now at most."""
    begin = time.monotonic()
    while any(map(alive, pids)) and time.monotonic() - begin < seconds:
        time.sleep(0.02)
    return any(map(alive, pids))


@linux
@pytest.mark.slow
@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "SIGKILL"])
def test_no_process_is_left(tmp_path, how):
    """Two workers wait for planners that hang."""
    ego = ExternalEgo(
        wrong_planner(tmp_path, 0.0, act="time.sleep(100)"), timeout=100.0
    )
    running = started_command(ego)
    planners = pids_in(tmp_path / "marks", 2)
    if how == "SIGINT":
        os.killpg(running.pid, signal.SIGINT)
    else:
        os.kill(running.pid, getattr(signal, how))
    running.join(20)
    assert not alive_after(planners, 30)
    assert running.exitcode == {"SIGINT": 130, "SIGTERM": 143, "SIGKILL": -9}[how]


def starting(folder):
    """The statements of a planner that starts two programs, and hangs."""
    (folder / "children").mkdir()
    return "; ".join(
        [
            "import subprocess",
            "sleep = [sys.executable, '-S', '-c', 'import time; time.sleep(100)']",
            "pids = [subprocess.Popen(sleep).pid for _ in range(2)]",
            f"[Path({str(folder / 'children')!r}, str(pid)).touch() for pid in pids]",
            "time.sleep(100)",
        ]
    )


class Starter(SameLaw):
    """An Ego that starts programs in the process that drives it, and hangs."""

    def __init__(self, statements):
        super().__init__(5)
        self.statements = statements

    def plan(self, world):
        exec(self.statements, {"sys": sys, "time": time, "Path": Path})


@linux
@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "how"),
    [
        ("external", "SIGKILL"),
        *product(["external", "inside"], ["SIGINT", "SIGTERM", "a worker is killed"]),
    ],
)
def test_nothing_is_left_of_what_planners_started(tmp_path, how, kind):
    """Two workers wait for planners that hang; SIGKILL ends the command's own process."""
    statements = starting(tmp_path)
    ego = Starter(statements)
    if kind == "external":
        ego = ExternalEgo(wrong_planner(tmp_path, 0.0, act=statements), timeout=100.0)
    running = started_command(ego)
    started = pids_in(tmp_path / "children", 4)
    if how == "SIGINT":
        os.killpg(running.pid, signal.SIGINT)
    elif how == "a worker is killed":
        os.kill(max(workers_of(running.pid)), signal.SIGKILL)
    else:
        os.kill(running.pid, getattr(signal, how))
    running.join(20)
    assert not alive_after(started, 30)
    assert running.exitcode == {"SIGINT": 130, "SIGTERM": 143, "SIGKILL": -9}.get(
        how, 2
    )


def workers_of(process):
    """The processes that were forked by another."""
    named = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [int(child) for child in named]


def test_messages_hold_the_world_field_by_field():
    scenes = scene_set(3, red_light_x=45.0).scenes
    world = World.at_start(scenes)
    mission = mission_of(scenes)
    scene = scenes[1]
    content = scene_messages(world, [1])
    kind, length, row, index, points, dots, lanes, lights = struct.unpack_from(
        "<8I", content
    )
    assert (kind, length, row, index) == (2, len(content) - 8, 1, 1)
    take = partial(_take, content, [32])
    assert take("3f", 1) == [(*scene["size"][0].tolist(), mission.end[1].item())]
    take("3f", points), take("if", 2)  # which the law reads
    result = take("i2f", dots)
    assert torch.tensor([dot[1:] for dot in result]).equal(scene["lane_points"])
    assert [dot[0] for dot in result] == scene["lane_index"].tolist()
    exits = torch.cat(
        [
            scene["lane_left"][:, None],
            scene["lane_right"][:, None],
            scene["lane_exits"],
        ],
        1,
    ).tolist()
    assert take("f8i", lanes) == [(3.5, *exits[lane]) for lane in range(lanes)]
    assert lanes == 2
    assert take("2f", lights) == [(45.0, 0.0)]
    assert take.args[1] == [len(content)]
    content = plan_message(world)
    take = partial(_take, content, [8])
    assert take("I", 1) == [(3,)]
    for row in range(3):
        ((number, step, agents, lights),) = take("4I", 1)
        assert (number, step, agents, lights) == (row, 0, 4, 1)
        assert take("I", 1) == [(1,)]
        present = scenes["valid"][row].nonzero()[:, 0].tolist()
        for agent, record in zip(present, take("2I8f", agents), strict=True):
            state, size = (
                scenes[key][row, agent].tolist() for key in ("start", "size")
            )
            assert record == (
                agent,
                int(scenes["agent_type"][row, agent]),
                *state,
                *size,
                0.0,
                0.0,
            )
    assert take.args[1] == [len(content)]


def _take(
    content,
    at,
    form,
    count,
):
    """The next `count` records of a message; at: [position]."""
    size = count * struct.calcsize("<" + form)
    result = list(struct.iter_unpack("<" + form, content[at[0] : at[0] + size]))
    at[0] += size
    return result


def test_what_cannot_be_is_named():
    fields = {"command": command_of().replace("external_planner", "cruise")}
    for inputs, why in (
        ({}, "give one of"),
        (fields, "before it listened"),
        ({"address": "unix:/no"}, "nothing listens"),
    ):
        with pytest.raises(InputError, match=why):
            ExternalEgo(**inputs, start_timeout=1.0).plan(
                World.at_start(scene_set().scenes)
            )


def test_it_is_asked_about_the_present_only():
    """Traffic that looks ahead would give a planner with a memory moments that never
    come."""
    ego = ExternalEgo(command_of())
    world = World.at_start(scene_set().scenes)
    ego.plan(world)
    world.step += 10
    ego.plan(world)
    with pytest.raises(InputError, match="drives in closed loop only"):
        ego.plan(world)
