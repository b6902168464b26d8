"""The raw simulator: dynamics, contact with everybody, off-road, reward and observation of a step, traffic replayed."""

from collections.abc import Iterator

import torch
from measure import Bench, Row
from tensordict import TensorDict

STEPS = 40


def simulator(bench: Bench) -> Iterator[Row]:
    """Agent-steps per second, by the agents' rows that are present, at 1 to 512 scenes a batch."""
    for batch in bench.batches(1, 4, 32, 128, 512):
        index = bench.pick(batch)
        env = bench.environment(index)
        action = TensorDict({"action": torch.zeros(batch, 2)}, batch_size=[batch])

        def steps(env=env, index=index, action=action):
            env.reset(TensorDict({"scene_index": index[:, None]}, batch_size=[len(index)]))
            for _ in range(STEPS):
                env._step(action)

        seconds = bench.best(steps)
        agents = bench.scenes.scenes["valid"][index].sum().item()
        yield bench.row("simulator", "step and observation", index, STEPS * agents / seconds, "agent-steps/s")
        yield bench.row("simulator", "step and observation", index, STEPS * batch / seconds, "ego steps/s")
