"""Planners outside of e2rl for the tests: that of examples/, its law as an Ego, and ones that go wrong in one scene."""

import sys
from pathlib import Path

import torch
from tensordict import TensorDict

from e2rl.planners.ego import Ego, EgoPolicy
from e2rl.planners.external import continued
from e2rl.scenes.boxes import to_frame
from e2rl.scenes.recording import LIGHT_RED
from e2rl.scenes.route import SPACING
from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.sim.mission import light_state_at, mission_of
from tests.synthetic import make_scenes

EXAMPLE = Path(__file__).parents[2] / "examples" / "external_planner.py"
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


def wrong_planner(folder: Path, bad: float, act: str = "pass", read: str = "pass", reply: str = "pass") -> str:
    """The command of a planner that does what the statements say where the ego of a scene is at y = bad: when it plans
    for the scene, when it reads the batch, or instead of its reply. Each of its processes leaves a file, its number, in
    folder/marks."""
    (folder / "marks").mkdir(exist_ok=True)
    fields = {"folder": str(EXAMPLE.parent), "marks": str(folder / "marks"), "bad": bad}
    (folder / "wrong.py").write_text(WRONG.format(act=act, read=read, reply=reply, **fields))
    return command_of(folder / "wrong.py")


def worlds(scenes):
    """An environment that begins each of the scenes, and its World."""
    env = DrivingEnv(scenes, SimSettings(), len(scenes), agents=True)
    env.reset(TensorDict({"scene_index": torch.arange(len(scenes))[:, None]}, [len(scenes)]))
    return env, env.world()


def world_of(**scene):
    """`worlds` of synthetic scenes, one if not said otherwise."""
    return worlds(make_scenes(**{"num_scenes": 1} | scene))


def driven(ego, steps=80, **scene):
    """What an ego does in a scene, and its last state [4]."""
    env, _ = world_of(**scene)
    data = env.rollout(steps, EgoPolicy(ego, env))
    return data, env.world().states[0, 0]


class SameLaw(Ego):
    """The law of examples/external_planner.py for whole batches, in e2rl."""

    def plan(self, world):
        mission, scene = mission_of(world.scene), world.scene
        now, size = world.states[:, 0].double(), scene["size"].double()
        speed, row = now[:, 3], torch.arange(len(now))
        near = (mission.points.double() - now[:, None, :2]).square().sum(-1).argmin(1)
        limit = mission.limit[row, near].double()
        desired = torch.where(limit > 0, limit, 10.0)
        along, aside = to_frame(world.states[:, 1:, :2].double(), now[:, None]).unbind(-1)
        free = along - (size[:, :1, 0] + size[:, 1:, 0]) / 2
        there = world.valid[:, 1:] & (along > 0) & (aside.abs() < (size[:, :1, 1] + size[:, 1:, 1]) / 2)
        gap, first = free.masked_fill(~there, torch.inf).min(1)
        other = world.states[:, 1:].double()[row, first]
        leader = torch.where(gap.isfinite(), other[:, 3] * torch.cos(other[:, 2] - now[:, 2]), 0.0)
        line = mission.light_s.double() - (SPACING * near + size[:, 0, 0] / 2)[:, None]
        red = (light_state_at(scene["light_state"], mission.light, world.step) == LIGHT_RED) & (line > 0)
        line = line.masked_fill(~red, torch.inf).amin(1)
        gap, leader = torch.minimum(gap, line), torch.where(line < gap, 0.0, leader)
        wanted = 4.0 + (speed * 1.2 + speed * (speed - leader) / (2 * 4.5**0.5)).clamp(min=0)
        push = 1 - (speed / desired) ** 4 - (wanted / gap.clamp(min=0.1)) ** 2
        goal = (near + 2 + (speed / SPACING).long()).clamp(max=mission.points.shape[1] - 1)
        ahead, left = to_frame(mission.points[row, goal].double(), now).unbind(-1)
        yaw_rate = 2 * speed * left / (ahead**2 + left**2).clamp(min=1.0)
        action = torch.stack([(1.5 * push).clamp(min=-8.0), yaw_rate], -1).float()
        steps = self.replan_every
        held = dynamics.rollout(world.states[:, 0], action[:, None].expand(-1, steps, -1))
        plan = torch.cat([held, held.new_zeros(len(held), 50 - steps, 4)], 1)
        return continued(plan, torch.full((len(held),), steps))
