"""The raw simulator on real maps, one core.

step and observation: what DrivingEnv does: the ego's dynamics, its contact with
everybody, off-road, reward and observation; the others are looked up. everybody driven:
the work that simulators of many egos report: dynamics of all agents, contact of all
pairs, off-road of all, no observation.
"""

from collections.abc import Iterator

import torch
from measure import Bench, Row
from tensordict import TensorDict
from torch import Tensor

from e2rl.run import fused
from e2rl.scenes.boxes import separation
from e2rl.scenes.drivable_area import off_road
from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv

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


def run(env: DrivingEnv, index: Tensor) -> None:
    """STEPS steps of scenes index [B] from their start."""
    action = TensorDict({"action": torch.zeros(len(index), 2)}, batch_size=[len(index)])
    env.reset(TensorDict({"scene_index": index[:, None]}, batch_size=[len(index)]))
    for _ in range(STEPS):
        env._step(action)


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
