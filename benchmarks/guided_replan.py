"""One replan of the synthesizer: features, encoding, K denoising steps, decoding; with
and without control."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from measure import Bench, Row

from e2rl.evaluation.build import build_ego
from e2rl.run.config import load_config

ETA = 2.0


def guided_replan(bench: Bench) -> Iterator[Row]:
    """Milliseconds a scene and replan in the middle of an episode, for the densest
    scenes and for the first ones, and of two egos' plans beside it."""
    sampling = build_ego(load_config("evaluate", ["ego=sampling"]))
    for scenes, agents in (
        ("densest scenes", bench.scenes.scenes["valid"].shape[1]),
        ("first scenes", None),
    ):
        for batch in bench.batches(1, 8, 32):
            index = bench.pick(batch, agents)
            world = bench.environment(index).world()
            plan = bench.ego.plan(world)
            state = bench.traffic.reset(world.scene, index, torch.full((batch,), ETA))
            state, _ = bench.traffic.replan(state, world, plan)
            calm = replace(state, eta=torch.zeros_like(state.eta))
            parts = {
                "unguided": lambda s=calm, w=world, p=plan: bench.traffic.replan(
                    s, w, p
                ),
                f"guided, eta {ETA:g}": lambda s=state, w=world, p=plan: (
                    bench.traffic.replan(s, w, p)
                ),
                "plan of lane_graph": lambda w=world: bench.ego.plan(w),
                "plan of sampling": lambda w=world: sampling.plan(w),
            }
            for variant, function in parts.items():
                value = 1e3 * bench.best(function) / batch
                yield bench.row(
                    "guided_replan", f"{variant}, {scenes}", index, value, "ms/scene"
                )
