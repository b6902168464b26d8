"""Planners outside of e2rl for the tests: that of examples/, its law as an Ego, and
ones that go wrong in one scene."""

import runpy
import sys
from pathlib import Path

import torch
from tensordict import TensorDict

from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.planners.ego_policy import EgoPolicy
from e2rl.planners.external import continued
from e2rl.planners.path import MissionPath
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv
from e2rl.sim.mission import mission_of
from e2rl.sim.settings import SimSettings
from tests.synthetic import make_scenes

EXAMPLE = Path(__file__).parents[2] / "examples" / "external_planner.py"
LAW = runpy.run_path(str(EXAMPLE))["act"]
WRONG = """
import math, os, struct, sys, time
from pathlib import Path
sys.path.insert(0, {folder!r})
import external_planner as example

act, read_plan, reply, bad, at = example.act, example.read_plan, example.Connection.reply, {bad}, []
Path({marks!r}, str(os.getpid())).touch()

def ill(agents):  # by the y at which the ego of a scene is
    return abs(agents[0][3] - bad) < 0.5

def wrong_act(known, lights, agents):
    at[:] = [ill(agents)]
    if at[0]:
        {act}
    return act(known, lights, agents)

def wrong_read(payload):
    scenes = list(read_plan(payload))
    if any(ill(agents) for _, _, agents in scenes):
        {read}
    return scenes

def wrong_reply(self, kind, payload):
    if kind == example.ACTION and at[0]:
        scene = payload[:4]
        {reply}
    reply(self, kind, payload)

example.act, example.read_plan, example.Connection.reply = wrong_act, wrong_read, wrong_reply
example.main()
"""


def command_of(path: Path = EXAMPLE) -> str:
    return f"{sys.executable} -S {path}"


def wrong_planner(
    folder: Path,
    bad: float,
    act: str = "pass",
    read: str = "pass",
    reply: str = "pass",
) -> str:
    """The command of a planner that does what the statements say where the ego of a
    scene is at y = bad: when it plans for the scene, when it reads the batch, or
    instead of its reply. Each of its processes leaves a file, its number, in
    folder/marks."""
    (folder / "marks").mkdir(exist_ok=True)
    fields = {"folder": str(EXAMPLE.parent), "marks": str(folder / "marks"), "bad": bad}
    (folder / "wrong.py").write_text(
        WRONG.format(act=act, read=read, reply=reply, **fields)
    )
    return command_of(folder / "wrong.py")


def worlds(scenes):
    """An environment that begins each of the scenes, and its World."""
    env = DrivingEnv(scenes, SimSettings(), len(scenes), agents=True)
    env.reset(
        TensorDict({"scene_index": torch.arange(len(scenes))[:, None]}, [len(scenes)])
    )
    return env, env.world()


def world_of(**scene):
    """`worlds` of synthetic scenes, one if not said otherwise."""
    return worlds(make_scenes(**{"num_scenes": 1} | scene))


def driven(ego, steps=80, **scene):
    """What an ego does in a scene, and its last state [4]."""
    data, states = all_driven(ego, make_scenes(**{"num_scenes": 1} | scene), steps)
    return data, states[0]


def all_driven(ego, scenes, steps=80, **sim):
    """What an ego does in each of the scenes until it is over in one, and its last
    states [B, 4]; sim: settings of the simulator."""
    env = DrivingEnv(scenes, SimSettings(**sim), len(scenes), agents=True)
    policy = EgoPolicy(ego, env)
    begin = env.reset(
        TensorDict({"scene_index": torch.arange(len(scenes))[:, None]}, [len(scenes)])
    )
    data = env.rollout(steps, policy, auto_reset=False, tensordict=begin)
    return data, env.world().states[:, 0]


class SameLaw(Ego):
    """The law of examples/external_planner.py in e2rl, told what the World and the
    missions hold."""

    def plan(self, world):
        mission = mission_of(world.scene)
        scene = world.scene
        current = world.states
        actions = []
        for row, place in enumerate(world.valid):
            route = torch.cat(
                [mission.points[row], mission.limit[row, :, None]], 1
            ).tolist()
            lines = list(
                zip(
                    mission.light[row].tolist(),
                    mission.light_s[row].tolist(),
                    strict=True,
                )
            )
            agents = torch.cat([current[row], scene["size"][row], 0 * current[row]], 1)[
                place
            ].tolist()
            lights = scene["light_state"][row, world.step[row]].tolist()
            certain = (*scene["size"][row, 0].tolist(), route, lines)
            actions.append(
                LAW(certain, lights, [(0, 0, *agent[:8]) for agent in agents])
            )
        steps = self.replan_every
        held = dynamics.rollout(
            current[:, 0], torch.tensor(actions)[:, None].expand(-1, steps, -1)
        )
        plan = torch.cat([held, held.new_zeros(len(held), 50 - steps, 4)], 1)
        return continued(plan, torch.full((len(held),), steps))


class Faster(Ego):
    """Speeds up along its mission, whoever is there."""

    def plan(self, world):
        """States [B, 51, 4]."""
        time = DT * torch.arange(PLAN_STEPS + 1)
        speed = world.states[:, 0, 3:] + 4.0 * time
        return MissionPath(world).drive(speed)
