"""The raw simulator on real maps, one core.

step and observation: what DrivingEnv does: the ego's dynamics, its contact with
everybody, off-road, reward and observation; the others are looked up. everybody driven:
the work that simulators of many egos report: dynamics of all agents, contact of all
pairs, off-road of all, no observation. vehicles re-aim: an episode with them by one
without.
"""

import time
from collections.abc import Iterator
from dataclasses import replace

import torch
from measure import Bench, Row
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv

from e2rl.run import fused
from e2rl.scenes.boxes import separation
from e2rl.scenes.drivable_area import off_road
from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv
from e2rl.traffic.e2.reaiming import ReactSettings, Reaiming
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.transform import AdversarialSynthesizer

STEPS = 80  # an episode, its reset included
AGENTS = 32  # a scene, where the data have scenes of so many
BATCHES = 1, 4, 32, 128, 512


def simulator(bench: Bench) -> Iterator[Row]:
    """Agent-steps per second, by the agents that are present, at 1 to 512 scenes a
    batch, eager and compiled."""
    kinds = (False, True) if bench.compile else (False,)
    for fast in kinds:
        name = ", compiled" if fast else ""
        fused.switch(fast)
        for batch in bench.batches(*BATCHES):
            index = bench.pick(batch, AGENTS)
            agents = bench.scenes.scenes["valid"][index].sum().item()
            env = DrivingEnv(bench.scenes, bench.sim, batch)
            wall, cpu = bench.both(lambda e=env, i=index: run(e, i))
            yield bench.row(
                "simulator",
                f"step and observation{name}",
                index,
                STEPS * agents / wall,
                "agent-steps/s",
            )
            yield bench.row(
                "simulator",
                f"step and observation{name}",
                index,
                STEPS * agents / cpu,
                "agent-steps/CPU s",
            )
    fused.switch(False)
    for batch in bench.batches(1, 16, 64):
        index = bench.pick(batch, AGENTS)
        for value, unit in zip(
            all_driven(bench, index),
            ("agent-steps/s", "agent-steps/CPU s"),
            strict=True,
        ):
            yield bench.row("simulator", "everybody driven", index, value, unit)
    yield from reacting(bench)


def run(env: DrivingEnv, index: Tensor) -> None:
    """STEPS steps of scenes index [B] from their start."""
    action = TensorDict({"action": torch.zeros(len(index), 2)}, batch_size=[len(index)])
    env.reset(TensorDict({"scene_index": index[:, None]}, batch_size=[len(index)]))
    for _ in range(STEPS):
        env._step(action)


def reacting(bench: Bench) -> Iterator[Row]:
    """Time of an episode in which vehicles re-aim in 70% of the environments, by that
    of its replay."""
    (batch,) = bench.batches(256)
    index = bench.pick(batch)
    scene = bench.scenes.batch(index)
    rows = torch.arange(batch)
    adversaries = scene["valid"] & (torch.arange(scene["valid"].shape[1]) < 4)
    traffic = {
        "scene_index": index,
        "states": scene["logged"],
        "valid": scene["logged_valid"],
    }
    pool = TrafficPool.stored(traffic | {"adversaries": adversaries}, 2.0)
    sim = replace(
        bench.sim, end_on_contact=False, end_off_road=False, end_when_gone=False
    )
    action = TensorDict({"action": torch.zeros(batch, 2)}, batch_size=[batch])

    def episode(reaction: Reaiming | None) -> None:
        transform = AdversarialSynthesizer(pool, lambda _: rows, reaction=reaction)
        env = TransformedEnv(DrivingEnv(bench.scenes, sim, batch), transform)
        now = env.reset()
        begin = time.process_time()
        for _ in range(STEPS):
            now = env.step(now.update(action))["next"]
        times[reaction is not None].append(time.process_time() - begin)

    times: dict[bool, list[float]] = {False: [], True: []}
    for seed in range(bench.repeats):  # in turn, since the machine's load changes
        episode(None), episode(Reaiming(ReactSettings(fraction=0.7), seed))
    ratio = min(times[True]) / min(times[False])
    yield bench.row(
        "simulator", "vehicles re-aim, CPU time", index, ratio, "of the replay's"
    )


def everybody(
    states: Tensor,
    action: Tensor,
    size: Tensor,
    pairs: Tensor,
    field: Tensor,
    origin: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """All agents' next states [B, N, 4], the pairs [2, Q] that touch [B, Q], metres
    beyond the border [B, N]."""
    states = dynamics.step(states, action)
    one, two = pairs
    touch = separation(states[:, one], size[:, one], states[:, two], size[:, two]) < 0
    return states, touch, off_road(states[..., :2], field, origin)


def all_driven(bench: Bench, index: Tensor) -> tuple[float, float]:
    """Agent-steps per second and per CPU second of `everybody`, AGENTS rows a scene,
    all counted: absent ones cost the same."""
    scene = bench.scenes.batch(index)
    start = scene["start"][:, :AGENTS]
    size = scene["size"][:, :AGENTS]
    agents = start.shape[1]
    pairs = torch.triu_indices(agents, agents, 1)
    action = torch.zeros(*start.shape[:2], 2)

    @torch.no_grad()
    def steps() -> None:
        states = start
        for _ in range(STEPS):
            states, *_ = everybody(
                states, action, size, pairs, scene["field"], scene["field_origin"]
            )

    wall, cpu = bench.both(steps)
    return STEPS * len(index) * agents / wall, STEPS * len(index) * agents / cpu
