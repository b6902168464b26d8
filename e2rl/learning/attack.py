"""The traffic of a round: what is ordered, and how it is made against an ego."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.evaluation.processes import Processes, in_processes
from e2rl.learning.solvability import Solved, unsearched
from e2rl.traffic.template import FULL

Synthesize = Callable[..., Mapping[str, Tensor]]  # (ego, scene_index [S], eta [S], seed), or these and template [S]
Solvable = Callable[[Mapping[str, Tensor]], Solved]
FLAGS = ("attacked", "contact", "kept")
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
    order: Order,
    synthesize: Synthesize,
    solvable: Solvable | None = None,
    nominal: bool = True,
    batch: int = 64,
    processes: Processes = 1,
) -> dict[str, Tensor]:
    """Traffic [R] of an order: the attack, without rows that no driver survives, then, with `nominal`, the same scenes
    at intensity 0.

    scene_index [R], eta [R], template [R], states [R, T+1, N, 4], valid [R, T+1, N], adversaries [R, N]; evasion
    [R, T, 2] and span [R, 2] as in `Solved`; of the attack kept [S] bool (rows not left out) and the shares of all its
    rows attacked [] (with an adversary) and contact [] (the ego was hit). Equal orders yield equal traffic, in
    whichever processes: `batch` scenes are the unit that one makes. Templates are given to `synthesize` only where one
    is not full.
    """
    rows = torch.arange(len(order.scenes)).split(batch)
    jobs = [(part, attack) for attack in ((True, False) if nominal else (True,)) for part in rows]
    work = partial(_make_part, order, synthesize, solvable)
    parts = list(in_processes(work, jobs, processes, cost=lambda job: job[1]))
    traffic = {name: torch.cat([part[name] for part in parts]) for name in parts[0] if name not in FLAGS}
    attack, contact, kept = (torch.cat([part[name] for part in parts[: len(rows)]]) for name in FLAGS)
    return traffic | {"attacked": attack.float().mean(), "contact": contact.float().mean(), "kept": kept}


def _make_part(
    order: Order, synthesize: Synthesize, solvable: Solvable | None, job: tuple[Tensor, bool]
) -> dict[str, Tensor]:
    """The traffic of an order's scenes rows [s], attacked or at intensity 0; and FLAGS [s] of them."""
    rows, attack = job
    scenes, none = order.scenes[rows], torch.zeros_like(order.eta[rows])
    eta, template = (order.eta[rows], order.template[rows]) if attack else (none, torch.full_like(scenes, FULL))
    limits = () if not attack or bool((order.template == FULL).all()) else (template,)
    made = synthesize(order.ego, scenes, eta, order.seed, *limits)
    solved = unsearched(made["states"]) if solvable is None or not attack else solvable(made)
    every = {name: made[name] for name in TRACKS} | {"eta": eta, "template": template}
    every |= {"evasion": solved.evasion, "span": solved.span}
    flags = made["adversaries"].any(-1), made["contact"], solved.kept
    return {name: value[solved.kept] for name, value in every.items()} | dict(zip(FLAGS, flags, strict=True))
