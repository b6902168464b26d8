"""The traffic of a round: what is ordered, how it is made against an ego, and which of
it some driver avoids."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from e2rl.metrics.contact import first_contact
from e2rl.metrics.evasion import find_evasions, spliced
from e2rl.planners.ego import Ego
from e2rl.run.errors import InputError
from e2rl.run.processes import Processes, in_processes
from e2rl.scenes.scene import SceneSet
from e2rl.sim import dynamics
from e2rl.sim.env import SimSettings
from e2rl.traffic.attempt import count_reasons, summary_of
from e2rl.traffic.traffic import FULL

DEPARTURE = 0.5  # m from where the ego drove at which an evasion has departed: 1 m/s^2 more or less lead so far in 1 s
LEAD = 10  # steps before its departure from which on an evasion acts
AFTER = 5  # steps after the contact until which it acts
LATE = 20  # steps before the contact at which an evasion is to begin: from its very start it would react to nothing


class Solved(NamedTuple):
    """Of synthesized traffic [S]: entered [S] bool: it is in D', as the ego was not hit
    or there is an evasion; evasion [S, T, 2]: its actions from the start; span [S, 2]
    int64: the steps from .. up to which it acts; both 0 without one."""

    entered: Tensor
    evasion: Tensor
    span: Tensor


def unsearched(states: Tensor) -> Solved:
    """Everything enters and no evasion is known, of traffic with states [S, T+1, N, 4]."""
    rows = states.shape[0]
    steps = states.shape[1] - 1
    span = torch.zeros(rows, 2, dtype=torch.int64)
    return Solved(
        torch.ones(rows, dtype=torch.bool), torch.zeros(rows, steps, 2), span=span
    )


def solvable(
    traffic: Mapping[str, Tensor], scenes: SceneSet, sim: SimSettings
) -> Solved:
    """A search with full knowledge of the others' motion (e2rl.metrics) where the ego
    was hit: for an evasion that begins LATE steps before the contact, and where none is
    found, for one from the start."""
    contact = traffic["contact"].cpu()
    solved = unsearched(traffic["states"])
    hit = contact.nonzero()[:, 0]
    if len(hit):
        scene = scenes.batch(traffic["scene_index"].cpu()[hit])
        states, valid = (traffic[name].cpu()[hit] for name in ("states", "valid"))
        first = first_contact(
            {
                "states": states,
                "valid": valid,
                **{key: scene[key] for key in ("size", "agent_type")},
            }
        )
        late = (first["stop"] - LATE).clamp(min=0).masked_fill(~first["hit"], 0)
        result = find_evasions(scene, states, valid=valid, sim=sim, moment=late)
        begin = late
        again = (~result.found & (late > 0)).nonzero()[:, 0]
        if len(again):
            result[again] = find_evasions(
                scene[again], states[again], valid=valid[again], sim=sim
            )
            begin = begin.index_fill(0, again, 0)
        solved.entered[hit] = result.found
        shown = (result.found & first["hit"]).nonzero()[:, 0]
        actions = spliced(
            dynamics.inverse(states[shown, :, 0]),
            result.actions[shown],
            moment=begin[shown],
        )
        evasion = dynamics.rollout(states[shown, 0, 0], actions)
        solved.evasion[hit[shown]] = actions
        solved.span[hit[shown]] = acting(
            evasion, states[shown, 1:, 0], begin=begin[shown], stop=first["stop"][shown]
        )
    return solved


def acting(evasion: Tensor, driven: Tensor, begin: Tensor, stop: Tensor) -> Tensor:
    """Steps [S, 2] from .. up to which evasions [S, T, 4] act instead of the drives
    driven [S, T, 4], both at steps 1..T; begin [S]: the step from which on they differ;
    stop [S]: of the drives' contacts.

    From LEAD steps before the evasion has departed from the drive by DEPARTURE, until
    AFTER steps past the contact.
    """
    apart = (evasion[..., :2] - driven[..., :2]).norm(dim=-1) > DEPARTURE
    departed = torch.where(apart.any(1), apart.int().argmax(1) + 1, stop)
    first = (departed.minimum(stop) - LEAD).maximum(begin)
    return torch.stack([first, (stop + AFTER).clamp(max=evasion.shape[1])], 1)


Synthesize = Callable[
    ..., Mapping[str, Any]
]  # (ego, scene_index [S], eta [S], seed), or these and template [S]
Solvable = Callable[[Mapping[str, Tensor]], Solved]
ATTACK, NOMINAL = "attack", "nominal traffic"  # of a round: what was made
FLAGS = ("attacked", "contact", "entered")
TRACKS = ("scene_index", "states", "valid", "adversaries", "owes")


@dataclass(frozen=True)
class Order:
    """What is to be synthesized: for round `number`, in scenes [S], at intensities eta
    [S], by causal templates [S] int64, from a seed, against an ego that does not change
    meanwhile."""

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
) -> tuple[dict[str, Tensor], list[dict]]:
    """Returns the traffic [R] of an order, and its rows that errored (round, scene,
    eta, reason, detail, traceback).

    The traffic is the attack without rows that no driver avoids, then, with `nominal`,
    the same scenes at intensity 0; both without errored rows. Equal orders yield equal
    traffic, in whichever processes: `batch` scenes are the unit that one makes. It has
    scene_index [R], eta [R], template [R], states [R, T+1, N, 4], valid [R, T+1, N],
    adversaries [R, N]; evasion [R, T, 2] and span [R, 2] as in `Solved`; of the attack
    entered [S] bool (rows in D') and the fractions of the made rows that were attacked
    [] (have an adversary) and in contact [] (the ego was hit). Raises InputError where
    no attack could be made.

    Args:
        synthesize: see `Evolution`; templates are given to it only where one is not
            full.
    """
    rows = torch.arange(len(order.scenes)).split(batch)
    jobs = [
        (part, attack)
        for attack in ((True, False) if nominal else (True,))
        for part in rows
    ]
    work = partial(_make_part, order, synthesize, solvable)
    parts = list(in_processes(work, jobs, processes=processes, cost=lambda job: job[1]))
    errored = [entry for part in parts for entry in part.pop("errored")]
    traffic = {
        name: torch.cat([part[name] for part in parts])
        for name in parts[0]
        if name not in FLAGS
    }
    attack, contact, entered = (
        torch.cat([part[name] for part in parts[: len(rows)]]) for name in FLAGS
    )
    if not len(attack):
        raise InputError(
            f"no traffic could be made: {summary_of(errored)}; mend the planner or the traffic"
        )
    fractions = {"attacked": attack.float().mean(), "contact": contact.float().mean()}
    return traffic | fractions | {"entered": entered}, errored


def _make_part(
    order: Order,
    synthesize: Synthesize,
    solvable: Solvable | None,
    job: tuple[Tensor, bool],
) -> dict[str, Any]:
    """The traffic of an order's scenes rows [s], attacked or at intensity 0; FLAGS of
    them (entered [s], the others of the rows that were made); and the errored rest."""
    rows, attack = job
    scenes = order.scenes[rows]
    none = torch.zeros_like(order.eta[rows])
    eta, template = (
        (order.eta[rows], order.template[rows])
        if attack
        else (none, torch.full_like(scenes, FULL))
    )
    limits = () if not attack or bool((order.template == FULL).all()) else (template,)
    made = synthesize(order.ego, scenes, eta, order.seed, *limits)
    why: Mapping[int, dict] = made.get("errored", {})
    there = torch.tensor(
        [row for row in range(len(rows)) if row not in why], dtype=torch.int64
    )
    searching = solvable if attack and len(there) else None
    solved = unsearched(made["states"]) if searching is None else searching(made)
    every = {name: made[name] for name in TRACKS if name in made} | {
        "eta": eta[there],
        "template": template[there],
    }
    every |= {"evasion": solved.evasion, "span": solved.span}
    entered = torch.zeros(len(rows), dtype=torch.bool).index_fill(
        0, there[solved.entered], True
    )
    flags = dict(
        zip(FLAGS, (made["adversaries"].any(-1), made["contact"], entered), strict=True)
    )
    about = {"round": order.number, "during": ATTACK if attack else NOMINAL}
    errored = [
        about | {"scene": int(scenes[row]), "eta": round(float(eta[row]), 4)} | reason
        for row, reason in why.items()
    ]
    return (
        {name: value[solved.entered] for name, value in every.items()}
        | flags
        | {"errored": errored}
    )


def counted(errored: Sequence[dict]) -> dict[str, float]:
    """Metrics of errored rollouts: how many, and how many for each reason."""
    reasons = {
        f"errored_{reason.replace(' ', '_')}": float(count)
        for reason, count in count_reasons(errored).items()
    }
    return {"errored": float(len(errored)), **reasons}


DRAW = 7_919  # apart from the other generators of a round's seed


def mixture(first: Synthesize, second: Synthesize, fraction: float) -> Synthesize:
    """A Synthesize that gives each scene to `second` with probability `fraction`, else
    to `first`.

    An ego that meets only adversaries that owe it nothing learns to flee, and meets
    those that give way in the same way. Who attacks a scene is drawn from the seed and
    the scene, so it is the same in whichever batch the scene lies. Templates are given
    to both; rows come in the order of the scenes.
    """

    def synthesize(
        ego: Ego, scenes: Tensor, eta: Tensor, seed: int, *template: Tensor
    ) -> dict[str, Any]:
        other = drawn(scenes, seed, fraction=fraction)
        parts = []
        places = []
        errored = dict[int, dict]()
        for make, chosen in ((first, ~other), (second, other)):
            rows = chosen.nonzero()[:, 0]
            if not len(rows):
                continue
            made = dict(
                make(
                    ego,
                    scenes[rows],
                    eta[rows],
                    seed,
                    *(each[rows] for each in template),
                )
            )
            own = made.pop("errored", {})
            errored |= {int(rows[place]): why for place, why in own.items()}
            places += [int(row) for place, row in enumerate(rows) if place not in own]
            parts.append(made)
        order = torch.tensor(places, dtype=torch.int64).argsort()
        return {
            name: torch.cat([part[name] for part in parts])[order] for name in parts[0]
        } | {"errored": errored}

    return synthesize


def drawn(scenes: Tensor, seed: int, fraction: float) -> Tensor:
    """Bool [S]: scenes [S] that a draw of probability `fraction` chooses, each by the
    seed and its own number."""
    largest = int(scenes.max()) + 1 if len(scenes) else 0
    draws = torch.rand(
        largest, generator=torch.Generator().manual_seed(seed * DRAW + 1)
    )
    return draws[scenes] < fraction
