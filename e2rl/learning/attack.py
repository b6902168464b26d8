"""The traffic of a round: what is ordered, and how it is made against an ego."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.learning.solvability import Solved, unsearched
from e2rl.traffic.template import FULL

Synthesize = Callable[..., Mapping[str, Tensor]]  # (ego, scene_index [S], eta [S], seed), or these and template [S]
Solvable = Callable[[Mapping[str, Tensor]], Solved]
TRACKS = ("scene_index", "states", "valid", "adversaries")


@dataclass(frozen=True)
class Order:
    """What is to be synthesized: for round `number`, in scenes [S], at intensities eta [S], by causal templates [S]
    int64, from a seed, against an ego that nobody changes meanwhile."""

    number: int
    scenes: Tensor
    eta: Tensor
    template: Tensor
    seed: int
    ego: Ego


def make_traffic(
    order: Order, synthesize: Synthesize, solvable: Solvable | None = None, nominal: bool = True
) -> dict[str, Tensor]:
    """Traffic [R] of an order: the attack, without rows that no driver survives, then, with `nominal`, the same scenes
    at intensity 0.

    scene_index [R], eta [R], template [R], states [R, T+1, N, 4], valid [R, T+1, N], adversaries [R, N]; evasion
    [R, T, 2] and span [R, 2] as in `Solved`; of the attack kept [S] bool (rows not left out) and the shares of all its
    rows attacked [] (with an adversary) and contact [] (the ego was hit). Equal orders yield equal traffic, in
    whichever process. Templates are given to `synthesize` only where one is not full.
    """
    limits = () if bool((order.template == FULL).all()) else (order.template,)
    attack = synthesize(order.ego, order.scenes, order.eta, order.seed, *limits)
    solved = unsearched(attack["states"]) if solvable is None else solvable(attack)
    kept = solved.kept
    rows = {name: attack[name][kept] for name in TRACKS} | {"eta": order.eta[kept], "template": order.template[kept]}
    rows |= {"evasion": solved.evasion[kept], "span": solved.span[kept]}
    if nominal:
        none = torch.zeros_like(order.eta)
        plain = dict(synthesize(order.ego, order.scenes, none, order.seed))
        plain |= {"eta": none, "template": torch.full_like(order.template, FULL)}
        plain |= unsearched(plain["states"])._asdict()
        rows = {name: torch.cat([value, plain[name]]) for name, value in rows.items()}
    shares = {"attacked": attack["adversaries"].any(-1).float().mean(), "contact": attack["contact"].float().mean()}
    return rows | shares | {"kept": kept}
