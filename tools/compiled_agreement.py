"""How far compiled rollouts are from eager ones: `python tools/compiled_agreement.py
[NUM_SCENES]`.

Bundled scenes, ego lane_graph, in nominal traffic and under e2 (eta = 2). A rollout's
difference is the largest distance, in 8 s, between the two places of a vehicle that is
there in both. Compiles what is missing, once.
"""

import sys

import torch
from omegaconf import OmegaConf
from torch import Tensor

import e2rl
from e2rl.run.fused import switch
from e2rl.sim.rollouts import Rollouts
from e2rl.traffic.fusing import prepare_fused

METHODS = {"nominal": 0.0, "e2": 2.0}  # intensity
QUANTILES = (0.5, 0.9, 0.95, 1.0)
CLOSE = 3e-3  # m


def main(num_scenes: str = "48") -> None:
    scenes = e2rl.load_scenes("bundled", int(num_scenes))
    ego = e2rl.make_ego("lane_graph")
    traffic = {name: e2rl.make_traffic(name, e2rl.load_prior()) for name in METHODS}
    prepare_fused(OmegaConf.create({"compile": True, "device": "cpu"}))
    print(
        "| traffic | rollouts | median | 90% | 95% | largest difference, m | above 3 "
        "mm | other contacts |"
    )
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, eta in METHODS.items():
        compiled = e2rl.roll_out(scenes, ego, traffic[name], eta=eta)
        switch(False)
        eager = e2rl.roll_out(scenes, ego, traffic[name], eta=eta)
        switch(True)
        distance = differences(compiled, eager)
        quantiles = " | ".join(
            f"{value:.2g}"
            for value in distance.quantile(torch.tensor(QUANTILES)).tolist()
        )
        contacts = int((compiled.contact != eager.contact).sum())
        print(
            f"| {name} | {len(distance)} | {quantiles} | "
            f"{int((distance > CLOSE).sum())} | {contacts} |",
            flush=True,
        )


def differences(first: Rollouts, second: Rollouts) -> Tensor:
    """The largest distance [B] m between the places of an agent at the same step."""
    apart = (first.states[..., :2] - second.states[..., :2]).norm(dim=-1)
    return (apart * (first.valid & second.valid)).flatten(1).amax(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
