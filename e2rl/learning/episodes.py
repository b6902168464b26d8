"""Outcomes of collected episodes, one row per episode."""

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

OUTCOMES = ("contact", "contact_vru", "off_road", "progress")
OUTCOME_KEYS = (
    ("traffic", "row"),
    "scene_index",
    *(("next", name) for name in ("timestep", "done", "episode_reward")),
    *(("next", "metrics", name) for name in OUTCOMES),
)


@dataclass
class Episodes:
    """E finished episodes, each field [E]: pool row and scene (int64), adversarial traffic, contact with any agent,
    off the road (bool), return, progress [m] and mean |acceleration| [m/s^2] (NaN if not measured)."""

    row: Tensor
    scene_index: Tensor
    adversarial: Tensor
    contact: Tensor
    off_road: Tensor
    returns: Tensor
    progress: Tensor
    acceleration: Tensor

    def __len__(self) -> int:
        return len(self.row)

    @property
    def failed(self) -> Tensor:
        """Bool [E]: ended by contact or off the road."""
        return self.contact | self.off_road

    def summary(self) -> dict[str, float]:
        """Means over all episodes and over those in adversarial and in nominal traffic; kinds without any are left
        out."""
        values = {"contact": self.contact.float(), "off_road": self.off_road.float(), "return": self.returns}
        values |= {"progress": self.progress, "acceleration": self.acceleration}
        kinds = {"": torch.ones_like(self.adversarial), "_adversarial": self.adversarial, "_nominal": ~self.adversarial}
        result = {"episodes": float(len(self))}
        for suffix, rows in kinds.items():
            for name, value in values.items():
                known = value[rows & ~value.isnan()]
                if len(known):
                    result[name + suffix] = known.mean().item()
        return result


NONE, NEVER = torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.bool)
NO_EPISODES = Episodes(NONE, NONE, NEVER, NEVER, NEVER, *[torch.zeros(0)] * 3)


def concatenated(parts: list[Episodes]) -> Episodes:
    """All episodes of the parts, in order."""
    parts = parts or [NO_EPISODES]
    return Episodes(*(torch.cat([getattr(part, name) for part in parts]) for name in Episodes.__dataclass_fields__))


def decisions(steps, hold: int):
    """Decisions (int or Tensor) in which an episode reaches so many steps; the last may be cut short."""
    return (steps + hold - 1) // hold


def finished_episodes(batches: list[TensorDictBase], adversarial: Tensor, horizon: int, hold: int = 1) -> Episodes:
    """Episodes of a round's batches [B, T_i] in order (OUTCOME_KEYS), all environments reset at the first frame.

    A frame is a decision, held for `hold` steps; an episode has at most `horizon` steps. Episodes that began too late
    to last so long before the end of the data are omitted: only the failures among them would be finished. adversarial
    [R]: of the pool's rows.
    """
    data = TensorDict.cat([batch.select(*OUTCOME_KEYS).to("cpu") for batch in batches], 1)
    after, metrics = data["next"], data["next", "metrics"]
    begin = torch.arange(data.shape[1]) + 1 - decisions(after["timestep"][..., 0], hold)
    ended = after["done"][..., 0] & (begin + decisions(horizon, hold) <= data.shape[1])
    row, contact = data["traffic", "row"][ended][:, 0], metrics["contact"] | metrics["contact_vru"]
    return Episodes(
        row,
        data["scene_index"][ended][:, 0],
        adversarial[row],
        contact[ended][:, 0],
        metrics["off_road"][ended][:, 0],
        after["episode_reward"][ended][:, 0],
        metrics["progress"][ended][:, 0],
        torch.full((len(row),), torch.nan),
    )
