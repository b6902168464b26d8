"""The simulator through TorchRL's Collector with the learned actor, as in an evolution
round."""

import time
from collections.abc import Iterator
from itertools import product

import torch
from measure import Bench, Row
from torchrl.collectors import Collector

from e2rl.planners.actor import ActorEgo
from e2rl.run import fused
from e2rl.sim.env import DrivingEnv

STEPS = 40


def collector(bench: Bench) -> Iterator[Row]:
    """Ego steps per second at 32 to 512 scenes a batch."""
    sizes = bench.batches(32, 128, 512)
    for batch, fast in product(sizes, (False, True) if bench.compile else (False,)):
        fused.switch(fast)
        env = DrivingEnv(bench.scenes, bench.sim, batch)
        actor = ActorEgo().network.actor
        source = Collector(
            env,
            actor,
            frames_per_batch=batch * STEPS,
            total_frames=batch * STEPS * (bench.repeats + 1),
            trust_policy=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        times = []
        with torch.no_grad():
            begin = time.perf_counter()
            for _ in source:
                times.append(time.perf_counter() - begin)
                begin = time.perf_counter()
        source.shutdown()
        yield bench.row(
            "collector",
            f"with the actor{', compiled' if fast else ''}",
            bench.pick(batch),
            batch * STEPS / min(times[1:]),
            "ego steps/s",
        )
    fused.switch(False)
