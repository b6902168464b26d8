"""The selection of a coalition shown in the skeleton figure."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from e2rl.errors import InputError
from e2rl.evaluation.files import ROLLOUTS, rollout_name
from e2rl.evaluation.protocol import SEEDS_APART, Method
from e2rl.evaluation.rollout_reader import read_rollout
from e2rl.scene.scene import SceneSet
from e2rl.synthesizer.selection import Selection
from e2rl.synthesizer.skeleton import chain_depth
from e2rl.synthesizer.topology import TopologySettings
from e2rl.traffic.rows import take_rows


@dataclass
class LongestChain:
    """Keeps a method's selection with the longest chain; ties go to the largest coalition, then to the greatest risk
    between its members, then to the first. `kept`: that selection, B = 1."""

    method: Method
    kept: Selection | None = None
    rank: tuple[float, ...] = (0, 0, 0)

    def __post_init__(self) -> None:
        self.method.traffic.on_selection = self

    def __call__(self, selection: Selection) -> None:
        depth, size = chain_depth(selection.target).amax(1), selection.coalition.sum(1)
        ranks = torch.stack([depth.double(), size.double(), link_risk(selection).amax(1).double()], 1)
        for row, rank in enumerate(map(tuple, ranks.tolist())):
            if rank > self.rank:
                self.kept, self.rank = take_rows(selection, torch.tensor([row])), rank

    @property
    def selection(self) -> Selection:
        """The kept selection; InputError if no adversary was chosen."""
        if self.kept is None:
            raise InputError(
                f"figure=skeleton: {self.method.name} at eta={self.method.eta:g} chose no adversary in any scene; name "
                "e2 first in methods, at an eta above 0, and evaluate more scenes, or name one with scene="
            )
        return self.kept

    @property
    def topology(self) -> TopologySettings:
        """Settings of the risk graphs of the method's selections; InputError for a method without them."""
        if self.method.traffic.topology is None:
            raise InputError(f"figure=skeleton: needs a method of e2 first in methods, not {self.method.name}")
        return self.method.traffic.topology

    def rollout(self, scenes: SceneSet, ego_name: str, folder: Path) -> dict:
        """The rollout of the kept selection, from its file; InputError if no adversary was chosen."""
        seed, scene = divmod(int(self.selection.seed), SEEDS_APART)
        identity = {"method": self.method.name, "ego_policy": ego_name, "eta": self.method.eta}
        name = rollout_name(identity | {"scene_id": scenes.scene_id[scene], "seed": seed})
        return read_rollout(Path(folder) / ROLLOUTS / name)


def link_risk(selection: Selection) -> Tensor:
    """Sum [B, T'] of the weights between the coalition's members and their targets, at each time."""
    onto = selection.target.clamp(min=0)[:, None, :, None].expand(*selection.weights.shape[:3], 1)
    return (selection.weights.gather(3, onto)[..., 0] * selection.coalition[:, None]).sum(-1)
