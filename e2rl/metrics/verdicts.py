"""The verdict on every collision of the ego: whose fault, preventable by whom, which duty broken (docs/verdicts.md).

A collision counts if it is the ego's fault or a careful and competent driver in its place would have prevented it.
"""

import torch
from torch import Tensor

from e2rl.metrics.contact import REAR, Batch
from e2rl.metrics.fault import at_fault
from e2rl.scene.recording import VEHICLE
from e2rl.verdicts.drivers import DRIVERS
from e2rl.verdicts.duty import Lanes, duties
from e2rl.verdicts.preventable import Collision, preventions

COLUMNS = ("preventable", *(f"preventable_{name}" for name in DRIVERS if name != "human"), "preventable_chain")


def verdict_columns(batch: Batch) -> Batch:
    """Of each collision: at_fault, preventable (by the human driver) and preventable_<model>, counted (0 or 1),
    preventable_chain (a follower's braking was needed for it), duty (index into DUTIES, -1 without a collision). Of
    each rollout: cfr_counted, cfr_preventable. Each [B], NaN where unknown."""
    hit, fault = batch["hit"], at_fault(batch)
    columns = {name: torch.full_like(fault, torch.nan) for name in COLUMNS}
    duty = torch.full_like(batch["stop"], -1)
    if hit.any():
        found, duty[hit] = collision_verdicts(batch, hit)
        for name, value in found.items():
            columns[name][hit] = value
    counted = torch.maximum(fault, columns["preventable"])
    known = torch.zeros_like(fault).masked_fill(batch["start_overlap"], torch.nan)
    shares = {"cfr_counted": counted, "cfr_preventable": columns["preventable"]}
    shares = {name: torch.where(hit, value, known) for name, value in shares.items()}
    return columns | shares | {"at_fault": fault, "counted": counted, "duty": duty}


def collision_verdicts(batch: Batch, hit: Tensor) -> tuple[Batch, Tensor]:
    """COLUMNS and duty of the collisions hit [B] bool."""
    vehicles = (batch["valid"] & (batch["agent_type"] == VEHICLE)[:, None])[hit]
    collision = Collision(batch["states"][hit], vehicles, batch["size"][hit], batch["partner"][hit], batch["stop"][hit])
    row, ran = torch.arange(len(collision.stop)), batch.get("ran_light")
    red = torch.full_like(collision.stop, -1) if ran is None else ran[hit][row, collision.partner]
    lanes = Lanes(batch["lane_points"][hit], batch["lane_index"][hit])
    duty = duties(collision, batch["kind"][hit] == REAR, red, lanes)
    result = preventions(collision)
    dtype = batch["states"].dtype
    columns = {f"preventable_{name}": value.avoided.to(dtype) for name, value in result.items()}
    human = result["human"]
    columns["preventable"] = columns.pop("preventable_human")
    columns["preventable_chain"] = (human.avoided & (human.followers > 0)).to(dtype)
    return columns, duty
