"""One replan of the synthesizer: features, encoding, K denoising steps, decoding; with and without control."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from measure import Bench, Row

ETA = 2.0


def guided_replan(bench: Bench) -> Iterator[Row]:
    """Milliseconds a scene and replan in the middle of an episode, for the densest scenes and for the first ones, and
    of the ego's plan beside it."""
    for scenes, agents in (("densest scenes", bench.scenes.scenes["valid"].shape[1]), ("first scenes", None)):
        for batch in bench.batches(1, 8, 32):
            index = bench.pick(batch, agents)
            world = bench.environment(index).world()
            plan = bench.ego.plan(world)
            episode = bench.synthesizer.begin(world.scene, index, torch.full((batch,), ETA))
            episode, _ = bench.synthesizer.replan(episode, world, plan)
            calm = replace(episode, eta=torch.zeros_like(episode.eta))
            parts = {
                "unguided": lambda e=calm, w=world, p=plan: bench.synthesizer.replan(e, w, p),
                f"guided, eta {ETA:g}": lambda e=episode, w=world, p=plan: bench.synthesizer.replan(e, w, p),
                "plan of lane_graph": lambda w=world: bench.ego.plan(w),
            }
            for variant, function in parts.items():
                value = 1e3 * bench.best(function) / batch
                yield bench.row("guided_replan", f"{variant}, {scenes}", index, value, "ms/scene")
