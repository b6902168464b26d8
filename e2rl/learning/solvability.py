"""Which synthesized traffic is worth learning from: that in which some driver would not have been hit."""

from collections.abc import Callable, Mapping

from torch import Tensor

from e2rl.evasion.search import find_evasions
from e2rl.scene.scene import SceneSet
from e2rl.sim.env import SimSettings

Solvable = Callable[[Mapping[str, Tensor]], Tensor]


def solvability(scenes: SceneSet, sim: SimSettings) -> Solvable:
    """A function of synthesized traffic (`Evolution.synthesize`) -> bool [S]: the ego was not hit, or a search with
    full knowledge of the others' motion finds how it would not have been (e2rl.evasion)."""

    def solvable(traffic: Mapping[str, Tensor]) -> Tensor:
        keep = ~traffic["contact"].cpu()
        hit = (~keep).nonzero()[:, 0]
        if len(hit):
            states, valid = (traffic[name].cpu()[hit] for name in ("states", "valid"))
            keep[hit] = find_evasions(scenes.batch(traffic["scene_index"].cpu()[hit]), states, valid, sim).found.cpu()
        return keep

    return solvable
