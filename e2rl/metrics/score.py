"""All metrics of rollouts, one row per rollout (docs/method.md, section 10)."""

import math

import torch
from torch import Tensor

from e2rl.metrics.catalogue import COMPUTE, METRICS, WORDS, row_columns
from e2rl.metrics.contact import first_contact
from e2rl.metrics.realism import Samples, realism, traffic_samples

CHUNK = 32  # rollouts scored at once: bounds the memory of the pairwise steps


def score_rollouts(rollouts: dict) -> tuple[list[dict], list[Samples]]:
    """(rows, samples): a dict of plain numbers and the realism samples of each of B rollouts.

    `rollouts` holds tensors with leading B: states [B, T+1, N, 4] (ego in row 0), valid [B, T+1, N], size [B, N, 2],
    agent_type [B, N] (0 vehicle), simulated, adversaries [B, N], logged, logged_valid as states and valid, lane_points
    [B, M, 2], lane_index [B, M], lane_width [B, L], drivable_points [B, D, 2], drivable_index [B, D], seed [B], seconds
    [B], eta (a number or [B]), lists scene_id, location, and where known parked [B, N], transport_adversary, _others,
    _anchor [B]. Both results go to `statistics.summarise`. A row's own realism rests on few samples; sets of rollouts
    pool them.
    """
    count = len(rollouts["states"])
    identity = {name: rollouts[name] for name in ("scene_id", "location", "seed", "seconds")}
    identity["eta"] = torch.as_tensor(rollouts["eta"], dtype=torch.float64).expand(count)
    rows, samples = [], []
    for begin in range(0, count, CHUNK):
        part = slice(begin, begin + CHUNK)
        columns, found = score_batch(as_doubles(rollouts, part))
        rows += plain_rows(columns | {name: values[part] for name, values in identity.items()}, len(found))
        samples += found
    return rows, samples


def as_doubles(rollouts: dict, part: slice) -> dict[str, Tensor]:
    """The tensors of some rollouts on the CPU, positions in float64, absent states zero (they may hold anything)."""
    batch = {key: value[part].cpu() for key, value in rollouts.items() if isinstance(value, Tensor) and value.dim()}
    for key, mask in (("states", "valid"), ("logged", "logged_valid")):
        batch[key] = batch[key].double().masked_fill(~batch[mask][..., None], 0.0)
    for key in ("size", "lane_points", "lane_width", "drivable_points"):
        batch[key] = batch[key].double()
    return batch


def score_batch(batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], list[Samples]]:
    """(columns {name: [B]}, realism samples per rollout) of a batch in float64."""
    traffic = batch["simulated"].clone()
    traffic[:, 0] = False
    batch = batch | {"traffic": traffic} | first_contact(batch)
    columns: dict[str, Tensor] = {}
    for name, compute in COMPUTE.items():
        found = compute(batch)
        columns |= found if isinstance(found, dict) else {METRICS[name].source: found}
    wrong = [name for name, column in columns.items() if column.shape != batch["stop"].shape]
    if wrong:
        raise ValueError(f"{', '.join(wrong)}: a metric is one number per rollout, a tensor [{len(traffic)}] here")
    samples = traffic_samples(batch)
    once, owner = torch.ones(1, 1, dtype=torch.float64), torch.zeros(1, dtype=torch.int64)
    single = [realism([sample], owner, once) for sample in samples]
    return columns | {name: torch.cat([values[name] for values in single]) for name in single[0]}, samples


def plain_rows(columns: dict[str, Tensor | list], count: int) -> list[dict]:
    """One dict of python values per rollout; NaN for columns of the catalogue that nothing computed.

    Columns of `catalogue.WORDS`, such as contact_type, become words; their index -1 becomes "".
    """
    lists = {name: value.tolist() if isinstance(value, Tensor) else value for name, value in columns.items()}
    for name, words in WORDS.items():
        lists[name] = [words[index] if index >= 0 else "" for index in lists[name]]
    unknown = dict.fromkeys(row_columns(), math.nan)
    return [unknown | {name: values[index] for name, values in lists.items()} for index in range(count)]
