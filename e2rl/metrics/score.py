"""All metrics of rollouts, one row per rollout (docs/reference/metrics.md)."""

import math

import torch
from torch import Tensor

from e2rl.metrics.catalogue import (
    COMPUTE,
    IDENTITY,
    LATER,
    METRICS,
    SOURCE,
    WORDS,
    Batch,
    Metric,
    columns,
    row_columns,
)
from e2rl.metrics.collisions import Collisions
from e2rl.metrics.contact import first_contact
from e2rl.metrics.realism import Samples, realism, traffic_samples
from e2rl.metrics.sideways import moved_into
from e2rl.metrics.verdicts import clean, judge
from e2rl.run.errors import InputError
from e2rl.scenes.reader_code import failed_line
from e2rl.sim.rollouts import Rollouts

CHUNK = 32  # rollouts scored at once: bounds the memory of the pairwise steps


@columns(
    Metric(
        "transport",
        "path KL of the control",
        tables="main adversaries",
    ),
    Metric("transport_adversary", "path KL of the control, adversaries"),
    Metric("transport_others", "path KL of the control, other vehicles"),
    Metric("transport_anchor", "anchor jump"),
    Metric(
        "seconds_per_rollout",
        "wall time",
        unit="s",
        column="seconds",
        cost=True,
        tables="main traffic methods",
    ),
    Metric(
        "nfe",
        "evaluations of the prior's network per rollout, one with a gradient twice",
        cost=True,
        tables="main methods",
    ),
)
def recorded_columns(batch: Batch) -> Batch:
    """What the rollout itself recorded, where known: the control's transport, wall
    time, network evaluations, and who is not there."""
    names = (
        "transport_adversary",
        "transport_others",
        "transport_anchor",
        "seconds",
        "nfe",
    )
    shared = {
        name: batch[name].to(batch["states"].dtype) for name in names if name in batch
    }
    shared |= {name: batch[name] for name in ("left_out",) if name in batch}
    return shared | (
        {"transport": shared[names[0]] + shared[names[1]]} if names[0] in shared else {}
    )


def score_rollouts(rollouts: Rollouts) -> tuple[list[dict], list[Samples]]:
    """Rows and realism samples of B rollouts, both for `statistics.summarise`.

    A row is a dict of plain numbers and words: the columns `catalogue.row_columns`, NaN
    where unknown, and those of SOURCE that the rollouts tell. Its own realism rests on
    few samples; sets of rollouts pool them. Sets `rollouts.driver`: the competent
    driver of the verdict in the ego's place, NaN without a collision.
    """
    rows = []
    samples = []
    drivers = []
    for begin in range(0, len(rollouts), CHUNK):
        part = rollouts[begin : begin + CHUNK]
        columns, features, driver = score_batch(as_doubles(part))
        identity = {name: part.get(name) for name in (*SOURCE, *IDENTITY)}
        rows += plain_rows(
            columns
            | {name: value for name, value in identity.items() if value is not None},
            len(part),
        )
        samples += features
        drivers.append(driver)
    rollouts.driver = torch.cat(drivers).float()
    return rows, samples


def as_doubles(rollouts: Rollouts) -> Batch:
    """The tensors of rollouts on the CPU, positions in float64, absent states zero
    (they may hold anything)."""
    batch = {
        key: value.cpu() for key, value in rollouts.items() if isinstance(value, Tensor)
    }
    for key, mask in (("states", "valid"), ("logged", "logged_valid")):
        batch[key] = batch[key].double().masked_fill(~batch[mask][..., None], 0.0)
    for key in ("size", "lane_points", "lane_width", "drivable_points"):
        batch[key] = batch[key].double()
    return batch


def columns_of(name: str, batch: Batch) -> Batch:
    """The columns {name: [B]} that a function of the catalogue makes of a batch.
    Raises InputError where one that a user registered raises, or returns others."""
    compute = COMPUTE[name]
    try:
        result = compute(batch)
    except Exception as error:  # outside code raises anything
        line = failed_line(compute, error.__traceback__)
        if not line:
            raise
        cause = f"{type(error).__name__} {str(error).partition(chr(10))[0]}"
        raise InputError(
            f"metric {name}: failed at {line}: {cause}; mend it there"
        ) from error
    columns = result if isinstance(result, dict) else {METRICS[name].source: result}
    shape = batch["stop"].shape
    for column, values in columns.items():
        if isinstance(values, Tensor) and values.shape == shape:
            continue
        size = f" {list(values.shape)}" if isinstance(values, Tensor) else ""
        raise InputError(
            f"metric {name}: {column} is a {type(values).__name__}{size}, expected one "
            f"number per rollout, a tensor {list(shape)} here"
        )
    return columns


def score_batch(batch: Batch) -> tuple[Batch, list[Samples], Tensor]:
    """Columns {name: [B]}, realism samples per rollout, and the competent driver's
    states [B, T+1, 4] of a batch."""
    traffic = batch["simulated"].clone()
    traffic[:, 0] = False
    batch = batch | {"traffic": traffic} | first_contact(batch)
    batch["valid"] = (
        batch["valid"] & ~batch["born_inside"]
    )  # nobody avoids who appears within the ego
    collisions = Collisions.of(batch)
    moved = moved_into(collisions)
    verdicts, driver = judge(batch, collisions, moved)
    batch |= verdicts | {
        "driver": driver,
        "collisions": collisions,
        "moved_into": moved,
    }
    result = verdicts
    for name in COMPUTE:
        result |= columns_of(name, batch)
    result["cfr_clean"] = clean(result)
    samples = traffic_samples(batch)
    once = torch.ones(
        1,
        1,
        dtype=torch.float64,
    )
    owner = torch.zeros(1, dtype=torch.int64)
    single = [
        realism(
            [sample],
            owner,
            draws=once,
        )
        for sample in samples
    ]
    return (
        result
        | {name: torch.cat([values[name] for values in single]) for name in single[0]},
        samples,
        driver,
    )


def plain_rows(found: dict[str, Tensor | list], count: int) -> list[dict]:
    """One dict of python values per rollout; NaN for columns of the catalogue that
    nothing computed.

    Columns of `catalogue.WORDS`, such as contact_type, become words; their index -1
    becomes "".
    """
    lists = {
        name: value.tolist() if isinstance(value, Tensor) else value
        for name, value in found.items()
    }
    for name, words in WORDS.items():
        lists[name] = [words[index] if index >= 0 else "" for index in lists[name]]
    unknown = dict.fromkeys(row_columns(), math.nan) | LATER | {"errored": 0.0}
    return [
        unknown | {name: values[index] for name, values in lists.items()}
        for index in range(count)
    ]
