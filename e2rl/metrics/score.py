"""All metrics of rollouts, one row per rollout (design.md section 5)."""

import torch
from torch import Tensor

from e2rl.metrics.catalogue import EVASION
from e2rl.metrics.contact import (
    KINDS,
    EgoContact,
    background_pairs,
    ego_overlap,
    first_contact,
    relative_speed,
    up_to,
    vulnerable_contact,
)
from e2rl.metrics.fault import ego_at_fault
from e2rl.metrics.off_road import off_road
from e2rl.metrics.proximity import (
    closest_approach_cost,
    ego_path,
    mean_acceleration,
    mean_worst_cost,
    progress,
    smallest_gap,
)
from e2rl.metrics.realism import MOVING, realism, traffic_features
from e2rl.metrics.standing import standing_columns
from e2rl.scene.recording import DT, VEHICLE

CHUNK = 32  # rollouts scored at once: bounds the memory of the pairwise steps
TRANSPORT = ("transport_adversary", "transport_others", "transport_anchor")
MAP = ("lane_points", "lane_index", "lane_width", "drivable_points", "drivable_index")
REALISM = ("real", "real_norm", "w1_a_lon", "w1_a_lat", "w1_jerk", "real_adv")


def score_rollouts(rollouts: dict, dt: float = DT) -> tuple[list[dict], list[dict[str, Tensor]]]:
    """(rows, features): a dict of plain numbers and the realism samples of each of B rollouts.

    `rollouts` holds tensors with leading B: states [B, T+1, N, 4] (ego in row 0), valid [B, T+1, N], size [B, N, 2],
    agent_type [B, N] (0 vehicle), simulated, adversaries [B, N], logged, logged_valid as states and valid, lane_points
    [B, M, 2], lane_index [B, M], lane_width [B, L], drivable_points [B, D, 2], drivable_index [B, D], seed [B], seconds
    [B], eta (a number or [B]), lists scene_id, location, and where known transport_adversary, _others, _anchor [B].
    Both results go to `statistics.summarise`. A row's own real values rest on few samples; sets of rollouts pool them.
    """
    rollouts_count = len(rollouts["states"])
    rows, features = [], []
    for begin in range(0, rollouts_count, CHUNK):
        part = slice(begin, min(begin + CHUNK, rollouts_count))
        columns, samples = score_batch(as_doubles(rollouts, part), dt)
        rows += plain_rows(columns | identity(rollouts, part), part.stop - part.start)
        features += samples
    return rows, features


def as_doubles(rollouts: dict, part: slice) -> dict[str, Tensor]:
    """The tensors of some rollouts on the host, positions in float64, absent states zero (they may hold anything)."""
    batch = {key: value[part].cpu() for key, value in rollouts.items() if isinstance(value, Tensor) and value.dim()}
    for key, mask in (("states", "valid"), ("logged", "logged_valid")):
        batch[key] = batch[key].double().masked_fill(~batch[mask][..., None], 0.0)
    for key in ("size", "lane_points", "lane_width", "drivable_points"):
        batch[key] = batch[key].double()
    return batch


def score_batch(batch: dict[str, Tensor], dt: float) -> tuple[dict[str, Tensor], list[dict[str, Tensor]]]:
    """(columns {name: [B]}, realism samples per rollout) of a batch in float64."""
    states, valid, size = batch["states"], batch["valid"], batch["size"]
    vehicle = batch["agent_type"] == VEHICLE
    traffic = batch["simulated"].clone()
    traffic[:, 0] = False
    area = ego_overlap(states, valid, size)
    contact = first_contact(states, valid, size, area * vehicle[:, None])
    stop = contact.stop
    columns = contact_columns(states, valid, size, batch["adversaries"], contact, dt)
    columns["cfr_vru"] = vulnerable_contact(area, vehicle, stop).to(states.dtype)
    pairs, pairs_at_start, touched = background_pairs(states, valid, size, traffic, stop)
    columns |= {"cfr_bg": (pairs > 0).to(states.dtype), "bg_pairs": pairs, "start_overlap_bg": pairs_at_start > 0}
    columns |= touched_columns(batch, traffic & touched, traffic) | standing_columns(batch, traffic)
    columns |= motion_columns(batch, contact, dt)
    columns |= off_road(states, valid, traffic, stop, {key: batch[key] for key in MAP})
    features = traffic_features(
        states, valid, batch["logged"], batch["logged_valid"], traffic, batch["adversaries"], stop, dt
    )
    once, owner = torch.ones(1, 1, dtype=states.dtype), torch.zeros(1, dtype=torch.int64)
    single = [realism([sample], owner, once) for sample in features]
    columns |= {name: torch.cat([values[name] for values in single]) for name in REALISM}
    columns |= {name: torch.full_like(columns["cfr"], torch.nan) for name in EVASION}
    return columns | transport_columns(batch, states), features


def contact_columns(
    states: Tensor, valid: Tensor, size: Tensor, adversaries: Tensor, contact: EgoContact, dt: float
) -> dict[str, Tensor]:
    """The metrics of the ego's first contact; NaN where the ego overlaps a vehicle at the start already."""
    hit, dtype = contact.hit, states.dtype
    columns = {"cfr": hit.to(dtype), "cfr_adv": (contact.touched & adversaries).any(-1).to(dtype)}
    for kind, name in enumerate(KINDS):
        columns[name] = (contact.kind == kind).to(dtype)
        columns[f"{name}_any"] = contact.kinds_any[:, kind].to(dtype)
    columns = {name: value.masked_fill(contact.overlaps_start, torch.nan) for name, value in columns.items()}
    step = contact.stop.to(dtype).masked_fill(~hit, torch.nan)
    return columns | {
        "rir": columns["rear"].masked_fill(~hit, torch.nan),
        "at_fault": ego_at_fault(states, valid, size, contact),
        "relvel": relative_speed(states, contact),
        "contact_step": step,
        "contact_time": step * dt,
        "contact_type": contact.kind,
        "partner": contact.partner,
        "start_overlap_ego": contact.overlaps_start,
    }


def touched_columns(batch: dict[str, Tensor], touched: Tensor, traffic: Tensor) -> dict[str, Tensor]:
    """Share of the traffic's moving vehicles (in the rollout or its log) that another one touches; touched [B, N]."""
    fastest = [
        (batch[track][..., 3] * batch[known]).amax(1)
        for track, known in (("states", "valid"), ("logged", "logged_valid"))
    ]
    moving = traffic & (torch.maximum(*fastest) > MOVING)
    number = moving.sum(-1)
    share = (touched & moving).sum(-1).to(batch["states"].dtype) / number  # 0 / 0 is NaN
    return {"touched": share, "moving_vehicles": number}


def motion_columns(batch: dict[str, Tensor], contact: EgoContact, dt: float) -> dict[str, Tensor]:
    """min_dtc, ttc_c, ttc_c_all, macc and progress, steps 1..stop."""
    states, valid, stop = batch["states"], batch["valid"], contact.stop
    gap = smallest_gap(states, valid, batch["size"], stop)
    cost = closest_approach_cost(states)
    seen = valid & valid[..., :1] & up_to(stop, states.shape[1])[..., None]
    seen[..., 0] = False
    path, count = ego_path(states, valid, stop)
    return {
        "min_dtc": gap.masked_fill(contact.hit, 0.0),
        "ttc_c": mean_worst_cost(cost, seen & batch["adversaries"][:, None]),
        "ttc_c_all": mean_worst_cost(cost, seen),
        "macc": mean_acceleration(path, count, dt),
        "progress": progress(path, count),
    }


def transport_columns(batch: dict[str, Tensor], states: Tensor) -> dict[str, Tensor]:
    """The control's path KL: adversaries, others and the anchor's jump apart; `transport` is the first two together."""
    unknown = torch.full((len(states),), torch.nan, dtype=states.dtype)
    columns = {name: batch[name].to(states.dtype) if name in batch else unknown for name in TRANSPORT}
    return columns | {"transport": columns["transport_adversary"] + columns["transport_others"]}


def identity(rollouts: dict, part: slice) -> dict[str, list]:
    """scene_id, location, seed, eta and seconds of some rollouts."""
    count = part.stop - part.start
    eta = rollouts["eta"]
    eta = eta[part].tolist() if isinstance(eta, Tensor) and eta.dim() else [float(eta)] * count
    return {
        "scene_id": rollouts["scene_id"][part],
        "location": rollouts["location"][part],
        "eta": eta,
        "seed": rollouts["seed"][part].tolist(),
        "seconds": rollouts["seconds"][part].tolist(),
    }


def plain_rows(columns: dict[str, Tensor | list], count: int) -> list[dict]:
    """One dict of python values per rollout; contact_type becomes front, side, rear or ""."""
    lists = {name: value.tolist() if isinstance(value, Tensor) else list(value) for name, value in columns.items()}
    rows = [{name: values[index] for name, values in lists.items()} for index in range(count)]
    for row in rows:
        row["contact_type"] = KINDS[row["contact_type"]] if row["contact_type"] >= 0 else ""
    return rows
