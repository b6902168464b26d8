"""The verdict on every collision of the ego: whose fault, preventable by whom, which
duty broken (docs/reference/verdicts.md).

A collision counts if it is the ego's fault or a careful and competent driver in its
place would have prevented it. Nobody prevents by braking what comes to an ego that
stands. A verdict on a partner that strikes the ego is `replayed`: it would have driven
differently towards another ego. A clean failure is preventable and not replayed, its
partner broke no duty, no other vehicles hit each other, and nobody left the road.

Where a vehicle moved sideways into the other (`sideways`), that decides whose fault it
is, and whoever the ego moved into broke at most the duties of light and direction. A
standing partner that the ego touches only because its recorded heading turned makes no
failure that counts.
"""

from functools import partial

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, declare, event, rate
from e2rl.metrics.collisions import EGO, Collisions
from e2rl.metrics.drivers import DRIVERS
from e2rl.metrics.duties import DUTIES, LIGHT, NONE, REAR_END, WRONG_WAY, duties
from e2rl.metrics.fault import (
    ego_at_fault,
    is_moving,
    leading_edge,
    turned_on_the_spot,
)
from e2rl.metrics.preventable import CREEPING, Collision, Prevention, preventions
from e2rl.scenes.recording import VEHICLE

TABLES = "main adversaries methods egos"
failure = partial(
    event,
    raised=1.0,
    tables=f"{TABLES} public",
)
share = partial(rate, per_collision=True)
declare(
    failure("cfr_counted", "a failure that counts: preventable, or the ego's fault"),
    failure("cfr_preventable", "a failure that a competent driver prevents"),
    failure("cfr_clean", "a clean failure: preventable, and nobody else did wrong"),
    share(
        "counted",
        "collisions that count",
        tables="main adversaries",
    ),
    share(
        "at_fault",
        "ego's fault, per collision",
        tables=f"{TABLES} public",
    ),
    share(
        "preventable",
        "prevented by UN R157's careful and competent driver",
        tables=TABLES,
    ),
    share("preventable_fsm", "prevented by the fuzzy safety model"),
    share("preventable_rss", "prevented by RSS"),
    share("preventable_regulation", "prevented at UN R157's limit"),
    share("preventable_chain", "prevented if a follower brakes, too"),
    share(
        "replayed",
        "prevented, given that the partner, which strikes the ego, is replayed",
    ),
    events=("duty",),
    words={"duty": DUTIES},
)
COLUMNS = (  # of collisions
    "preventable",
    *(f"preventable_{name}" for name in DRIVERS if name != "human"),
    "preventable_chain",
    "replayed",
    "at_fault",
    "counted",
)


def judge(
    batch: Batch,
    collisions: Collisions,
    moved_into: Tensor,
) -> tuple[Batch, Tensor]:
    """The verdicts on B rollouts, and the driver that they rest on.

    Args:
        batch: with the fields of `first_contact`.
        collisions: those of the batch.
        moved_into: [C, 2] bool, see `sideways`.

    Returns:
        columns: [B] each, NaN where unknown: COLUMNS of each collision (0 or 1), duty
            (index into DUTIES, -1 without a collision); of each rollout cfr_counted,
            cfr_preventable.
        driver: states [B, T+1, 4] of the human driver in the ego's place, NaN without a
            collision.
    """
    states = batch["states"]
    if len(collisions):
        verdicts, duty, human = collision_verdicts(batch, collisions, moved_into)
        columns = {
            name: collisions.column(verdicts[name].to(states.dtype), torch.nan)
            for name in COLUMNS
        }
        columns["duty"] = collisions.column(duty, -1)
        driver = collisions.column(human.states, torch.nan)
    else:
        driver = torch.full_like(states[:, :, 0], torch.nan)
        columns = dict.fromkeys(COLUMNS, driver[:, 0, 0])
        columns["duty"] = torch.full_like(batch["stop"], -1)
    no_contact = states.new_zeros(len(states)).masked_fill(
        batch["start_overlap"], torch.nan
    )
    for name in ("counted", "preventable"):
        columns[f"cfr_{name}"] = torch.where(batch["hit"], columns[name], no_contact)
    return columns, driver


def collision_verdicts(
    batch: Batch,
    collisions: Collisions,
    moved_into: Tensor,
) -> tuple[Batch, Tensor, Prevention]:
    """COLUMNS [C] bool, duty [C] and the human driver's Prevention of C > 0 collisions;
    arguments as in `judge`."""
    hit = collisions.hit
    is_vehicle = batch["agent_type"][hit] == VEHICLE
    by_driver = preventions(
        Collision(
            batch["states"][hit],
            batch["valid"][hit] & is_vehicle[:, None],
            size=batch["size"][hit],
            partner=batch["partner"][hit],
            stop=collisions.stop,
        )
    )
    speed = collisions.states_at(collisions.before)[:, EGO, 3].abs()
    counts = (speed > CREEPING) & ~turned_on_the_spot(collisions)
    verdicts = {
        f"preventable_{name}": prevention.avoided & counts
        for name, prevention in by_driver.items()
    }
    preventable = verdicts.pop("preventable_human")
    human = by_driver["human"]
    partner_strikes = is_moving(collisions)[:, 1] & (
        collisions.kind != leading_edge(collisions)
    )

    duty, ego_broke = duties(collisions, human.struck)
    fault = ego_at_fault(
        collisions,
        moved_into,
        struck=human.struck,
        broke=ego_broke & (duty != REAR_END),
        prevented=preventable,
    )
    only_ego_moved = moved_into[:, 0] & ~moved_into[:, 1]
    excused = only_ego_moved & (duty != LIGHT) & (duty != WRONG_WAY)
    verdicts |= {
        "preventable": preventable,
        "preventable_chain": preventable & (human.followers > 0),
        "replayed": preventable & partner_strikes,
        "at_fault": fault,
        "counted": fault | preventable,
    }
    return verdicts, duty.masked_fill(excused, NONE), human


def clean(columns: Batch) -> Tensor:
    """cfr_clean [B] of the columns of B rollouts: 1 for a clean failure, NaN where
    `cfr_preventable` is unknown."""
    wrong = columns["duty"] > NONE
    for name in ("replayed", "cfr_bg", "aor_any", "ego_off_road"):
        wrong = wrong | (columns[name] == 1)
    preventable = columns["cfr_preventable"]
    return preventable.where(~wrong | preventable.isnan(), 0.0)
