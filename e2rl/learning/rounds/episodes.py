"""Outcomes of the episodes that a policy drove in a round."""

import torch
from tensordict import TensorDict, TensorDictBase, tensorclass
from torch import Tensor

from e2rl.sim.env import METRICS, touches

OUTCOME_KEYS = (
    ("traffic", "row"),
    "scene_index",
    *(("next", name) for name in ("timestep", "done", "episode_reward")),
    *(("next", "metrics", name) for name in METRICS),
)


@tensorclass
class Episodes:
    """E finished episodes, each field [E]: pool row and scene (int64), adversarial
    traffic, contact with any agent, off the road (bool), return, progress [m]."""

    row: Tensor
    scene_index: Tensor
    adversarial: Tensor
    contact: Tensor
    off_road: Tensor
    returns: Tensor
    progress: Tensor

    @property
    def failed(self) -> Tensor:
        """Bool [E]: ended by contact or off the road."""
        return self.contact | self.off_road

    def summary(self) -> dict[str, float]:
        """Means over all episodes and over those in adversarial and in nominal traffic;
        kinds without any are left out."""
        values = {
            "contact": self.contact.float(),
            "off_road": self.off_road.float(),
            "return": self.returns,
            "progress": self.progress,
        }
        kinds = {
            "": torch.ones_like(self.adversarial),
            "_adversarial": self.adversarial,
            "_nominal": ~self.adversarial,
        }
        return {"episodes": float(len(self))} | {
            name + suffix: value[rows].mean().item()
            for suffix, rows in kinds.items()
            if rows.any()
            for name, value in values.items()
        }


def decisions(steps, hold: int):
    """Decisions (int or Tensor) in which an episode reaches so many steps; the last may
    be cut short."""
    return (steps + hold - 1) // hold


def outcomes(data: TensorDictBase) -> TensorDictBase:
    """What is read of a batch [B, T], on the CPU."""
    return data.select(*OUTCOME_KEYS).cpu().clone()


def finished_episodes(
    batches: list[TensorDictBase],
    adversarial: Tensor,
    *,
    horizon: int,
    hold: int = 1,
) -> Episodes:
    """Returns the episodes of a round.

    Those that began too late to last `horizon` steps before the end of the data are
    omitted: only the failures among them would be finished.

    Args:
        batches: `outcomes` [B, T_i] in order; all environments are reset at the first
            frame.
        adversarial: of the pool's rows, [R] bool.
        horizon: steps of an episode at most.
        hold: steps of a frame, for which a decision is held.

    Returns:
        E episodes.
    """
    data = TensorDict.cat(batches, 1)
    after = data["next"]
    metrics = after["metrics"]
    frames = data.shape[1]
    begin = torch.arange(frames) + 1 - decisions(after["timestep"][..., 0], hold)
    ended = after["done"][..., 0] & (begin + decisions(horizon, hold) <= frames)
    row = data["traffic", "row"][ended][:, 0]
    return Episodes(
        row,
        data["scene_index"][ended][:, 0],
        adversarial=adversarial[row],
        contact=touches(metrics)[ended][:, 0],
        off_road=metrics["off_road"][ended][:, 0],
        returns=after["episode_reward"][ended][:, 0],
        progress=metrics["progress"][ended][:, 0],
        batch_size=[len(row)],
    )
