"""The traffic of a round: what is ordered, and how it is made against an ego."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from e2rl.ego.base import Ego
from e2rl.errors import InputError
from e2rl.evaluation.processes import Processes, in_processes
from e2rl.learning.solvability import Solved, unsearched
from e2rl.traffic.attempt import count_reasons, summary_of
from e2rl.traffic.template import FULL

Synthesize = Callable[..., Mapping[str, Any]]  # (ego, scene_index [S], eta [S], seed), or these and template [S]
Solvable = Callable[[Mapping[str, Tensor]], Solved]
ATTACK, NOMINAL = "attack", "nominal traffic"  # of a round: what was made
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
    at intensity 0; without rows that `synthesize` could not make. Raises InputError where no attack could be made.

    scene_index [R], eta [R], template [R], states [R, T+1, N, 4], valid [R, T+1, N], adversaries [R, N]; evasion
    [R, T, 2] and span [R, 2] as in `Solved`; of the attack kept [S] bool (rows that entered) and the shares of the rows
    that were made attacked [] (with an adversary) and contact [] (the ego was hit); ended [E] uint8 (`ended_of`). Equal
    orders yield equal traffic, in whichever processes: `batch` scenes are the unit that one makes. Templates are given
    to `synthesize` only where one is not full.
    """
    rows = torch.arange(len(order.scenes)).split(batch)
    jobs = [(part, attack) for attack in ((True, False) if nominal else (True,)) for part in rows]
    work = partial(_make_part, order, synthesize, solvable)
    parts = list(in_processes(work, jobs, processes, cost=lambda job: job[1]))
    ended = [entry for part in parts for entry in part.pop("ended")]
    traffic = {name: torch.cat([part[name] for part in parts]) for name in parts[0] if name not in FLAGS}
    attack, contact, kept = (torch.cat([part[name] for part in parts[: len(rows)]]) for name in FLAGS)
    if not len(attack):
        raise InputError(f"no traffic could be made: {summary_of(ended)}; mend the planner or the traffic")
    text = torch.frombuffer(bytearray(json.dumps(ended).encode()), dtype=torch.uint8)
    shares = {"attacked": attack.float().mean(), "contact": contact.float().mean()}
    return traffic | shares | {"kept": kept, "ended": text}


def _make_part(
    order: Order, synthesize: Synthesize, solvable: Solvable | None, job: tuple[Tensor, bool]
) -> dict[str, Any]:
    """The traffic of an order's scenes rows [s], attacked or at intensity 0; FLAGS of them (kept [s], the others of the
    rows that were made); and what ended the rest."""
    rows, attack = job
    scenes, none = order.scenes[rows], torch.zeros_like(order.eta[rows])
    eta, template = (order.eta[rows], order.template[rows]) if attack else (none, torch.full_like(scenes, FULL))
    limits = () if not attack or bool((order.template == FULL).all()) else (template,)
    made = synthesize(order.ego, scenes, eta, order.seed, *limits)
    lost: Mapping[int, dict] = made.get("ended", {})
    there = torch.tensor([row for row in range(len(rows)) if row not in lost], dtype=torch.int64)
    searching = solvable if attack and len(there) else None
    solved = unsearched(made["states"]) if searching is None else searching(made)
    every = {name: made[name] for name in TRACKS} | {"eta": eta[there], "template": template[there]}
    every |= {"evasion": solved.evasion, "span": solved.span}
    kept = torch.zeros(len(rows), dtype=torch.bool).index_fill(0, there[solved.kept], True)
    flags = dict(zip(FLAGS, (made["adversaries"].any(-1), made["contact"], kept), strict=True))
    about = {"round": order.number, "during": ATTACK if attack else NOMINAL}
    ended = [about | {"scene": int(scenes[row]), "eta": round(float(eta[row]), 4)} | why for row, why in lost.items()]
    return {name: value[solved.kept] for name, value in every.items()} | flags | {"ended": ended}


def ended_of(traffic: Mapping[str, Tensor]) -> list[dict]:
    """Of a round's traffic: the rows that ended while they were made (e2rl/traffic/attempt.py), each with its round,
    scene, eta, reason, detail and traceback."""
    return json.loads(traffic["ended"].numpy().tobytes())


def counted(ended: Sequence[dict]) -> dict[str, float]:
    """Metrics of rollouts that ended for an error: how many, and how many for each reason."""
    reasons = {f"ended_{reason.replace(' ', '_')}": float(count) for reason, count in count_reasons(ended).items()}
    return {"ended": float(len(ended)), **reasons}
