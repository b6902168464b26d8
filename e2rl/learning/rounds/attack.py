"""The traffic of a round: what is ordered, how it is made against an ego, and which of
it some driver avoids."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from e2rl.metrics.contact import first_contact
from e2rl.metrics.evasion import find_evasions
from e2rl.planners.ego import Ego
from e2rl.run.errors import InputError
from e2rl.scenes.scene import SceneSet
from e2rl.sim.settings import SimSettings
from e2rl.traffic.attempt import count_reasons, summary_of

LATE = 20  # steps before the contact at which an evasion is to begin


def solvable(
    traffic: Mapping[str, Tensor],
    scenes: SceneSet,
    sim: SimSettings,
) -> Tensor:
    """Bool [S]: synthesized traffic that enters D': the ego was not hit, or a search
    with full knowledge of the others' motion finds an evasion.

    Evasions begin LATE steps before the contact, or where none of these is found, at
    the start.
    """
    hit = traffic["contact"].cpu().nonzero()[:, 0]
    avoidable = torch.ones(len(traffic["contact"]), dtype=torch.bool)
    if not len(hit):
        return avoidable
    scene = scenes.batch(traffic["scene_index"].cpu()[hit])
    states = traffic["states"].cpu()[hit]
    valid = traffic["valid"].cpu()[hit]
    tracks = {"states": states, "valid": valid}
    first = first_contact(
        tracks | {name: scene[name] for name in ("size", "agent_type")}
    )
    late = (first["stop"] - LATE).clamp(min=0).masked_fill(~first["hit"], 0)
    evaded = find_evasions(scene, states, valid=valid, sim=sim, moment=late).found
    again = (~evaded & (late > 0)).nonzero()[:, 0]
    if len(again):
        evaded[again] = find_evasions(
            scene[again],
            states[again],
            valid=valid[again],
            sim=sim,
        ).found
    avoidable[hit] = evaded
    return avoidable


Synthesize = Callable[[Ego, Tensor, Tensor, int], Mapping[str, Any]]
Solvable = Callable[[Mapping[str, Tensor]], Tensor]
ATTACK = "attack"  # what of a round was being made
NOMINAL = "nominal traffic"
FLAGS = ("attacked", "contact", "entered")  # of the attack alone
TRACKS = ("scene_index", "states", "valid", "adversaries")


@dataclass(frozen=True)
class Order:
    """What is to be synthesized: for round `number`, in scenes [S], by attacks [S]
    int64 (0 the synthesizer's, 1 a harder one) in their order, at intensities eta [S],
    from a seed, against an ego that does not change meanwhile."""

    number: int
    scenes: Tensor
    attack: Tensor
    eta: Tensor
    seed: int
    ego: Ego


def make_traffic(
    order: Order,
    attacks: Sequence[Synthesize],
    *,
    solvable: Solvable | None = None,
    nominal: bool = True,
    batch: int = 64,
) -> tuple[dict[str, Tensor], list[dict]]:
    """Returns the traffic [R] of an order, and its rows that errored.

    The traffic is the attack without rows that no driver avoids, then the same scenes
    at intensity 0; both without errored rows. Equal orders yield equal traffic.

    Args:
        order: what is to be made.
        attacks: see `Evolution`.
        solvable: which attacked rows enter D'; None: all.
        nominal: make the scenes at intensity 0, too.
        batch: scenes that are made at once.

    Returns:
        Tensors scene_index [R], eta [R], states [R, T+1, N, 4], valid [R, T+1, N] and
        adversaries [R, N]; of the attack entered [S] bool (rows in D'), and
        attacked (it has an adversary) and contact (the ego was hit), [S], NaN where the
        row errored. Errored rows as dicts of round, scene, eta,
        reason, detail, traceback.

    Raises:
        InputError: no attack could be made.
    """
    rows = torch.arange(len(order.scenes))
    attacked = [
        _make_part(order, synthesize, part, solvable=solvable, attack=True)
        for number, synthesize in enumerate(attacks)
        for part in rows[order.attack == number].split(batch)
        if len(part)
    ]
    calm = [
        _make_part(order, attacks[0], part, solvable=solvable, attack=False)
        for part in (rows.split(batch) if nominal else ())
    ]
    parts = attacked + calm
    errored = [entry for part in parts for entry in part.pop("errored")]
    traffic = {
        name: torch.cat([part[name] for part in parts])
        for name in parts[0]
        if name not in FLAGS
    }
    flags = {name: torch.cat([part[name] for part in attacked]) for name in FLAGS}
    if flags["contact"].isnan().all():
        raise InputError(
            f"no traffic could be made: {summary_of(errored)}; "
            "mend the planner or the traffic"
        )
    return traffic | flags, errored


def _make_part(
    order: Order,
    synthesize: Synthesize,
    rows: Tensor,
    *,
    solvable: Solvable | None,
    attack: bool,
) -> dict[str, Any]:
    """The traffic of an order's scenes rows [s], attacked or at intensity 0; FLAGS of
    them [s]; and the errored rest."""
    scenes = order.scenes[rows]
    eta = order.eta[rows] if attack else torch.zeros_like(order.eta[rows])
    traffic = synthesize(order.ego, scenes, eta, order.seed)
    causes: Mapping[int, dict] = traffic.get("errored", {})
    places = torch.tensor(
        [row for row in range(len(rows)) if row not in causes], dtype=torch.int64
    )
    enters = torch.ones(len(places), dtype=torch.bool)
    if attack and len(places) and solvable is not None:
        enters = solvable(traffic)
    tracks = {name: traffic[name] for name in TRACKS} | {"eta": eta[places]}
    unknown = torch.full((len(rows),), torch.nan)
    about = {"round": order.number, "during": ATTACK if attack else NOMINAL}
    errored = [
        about | {"scene": int(scenes[row]), "eta": round(float(eta[row]), 4)} | cause
        for row, cause in causes.items()
    ]
    return {
        **{name: value[enters] for name, value in tracks.items()},
        "attacked": unknown.index_copy(
            0, places, traffic["adversaries"].any(-1).float()
        ),
        "contact": unknown.index_copy(0, places, traffic["contact"].float()),
        "entered": torch.zeros(len(rows), dtype=torch.bool).index_fill(
            0,
            places[enters],
            True,
        ),
        "errored": errored,
    }


def counted(errored: Sequence[dict]) -> dict[str, float]:
    """Metrics of errored rollouts: how many, and how many for each reason."""
    reasons = {
        f"errored_{reason.replace(' ', '_')}": float(count)
        for reason, count in count_reasons(errored).items()
    }
    return {"errored": float(len(errored)), **reasons}
