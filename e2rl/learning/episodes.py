"""What the collected episodes came to, one row per episode."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

OUTCOME_KEYS = (
    "traffic_row",
    "scene_index",
    ("next", "timestep"),
    ("next", "done"),
    ("next", "reward"),
    ("next", "metrics", "contact"),
    ("next", "metrics", "contact_vru"),
    ("next", "metrics", "off_road"),
    ("next", "metrics", "progress"),
)


@dataclass
class Episodes:
    """E finished episodes, each field [E]: pool row and scene (int64), adversarial traffic, contact with anyone, off
    the road (bool), return, progress [m] and mean |acceleration| [m/s^2] (NaN where it was not measured)."""

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
        values = {
            "contact": self.contact.float(),
            "off_road": self.off_road.float(),
            "return": self.returns,
            "progress": self.progress,
            "acceleration": self.acceleration,
        }
        kinds = {"": torch.ones_like(self.adversarial), "_adversarial": self.adversarial, "_nominal": ~self.adversarial}
        result = {"episodes": float(len(self))}
        for suffix, rows in kinds.items():
            for name, value in values.items():
                known = value[rows & ~value.isnan()]
                if len(known):
                    result[name + suffix] = known.mean().item()
        return result


def finished_episodes(batches: list[TensorDictBase], adversarial: Tensor, horizon: int) -> Episodes:
    """Episodes of a round's batches [B, T_i] in order (OUTCOME_KEYS), all environments reset at the first frame.

    Episodes that began less than `horizon` steps before the end of the data count for nothing: of these only the short
    ones, the failures, are finished. adversarial [R]: of the pool's rows.
    """
    data = torch.cat([batch.select(*OUTCOME_KEYS).to("cpu") for batch in batches], 1)
    flat = {key: data[key][..., 0] for key in OUTCOME_KEYS}
    steps = flat["next", "timestep"]
    begin = torch.arange(data.shape[1]) - steps + 1
    ended = flat["next", "done"] & (begin + horizon <= data.shape[1])
    padded = torch.nn.functional.pad(flat["next", "reward"].double().cumsum(1), (1, 0))
    total = padded[:, 1:] - padded.gather(1, begin.clamp(min=0))
    contact = flat["next", "metrics", "contact"] | flat["next", "metrics", "contact_vru"]
    row = flat["traffic_row"][ended]
    return Episodes(
        row=row,
        scene_index=flat["scene_index"][ended],
        adversarial=adversarial[row],
        contact=contact[ended],
        off_road=flat["next", "metrics", "off_road"][ended],
        returns=total[ended].float(),
        progress=flat["next", "metrics", "progress"][ended],
        acceleration=torch.full((len(row),), torch.nan),
    )
