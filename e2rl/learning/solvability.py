"""Solvability of synthesized traffic: some driver could have avoided the collision."""

from collections.abc import Mapping

from torch import Tensor

from e2rl.evasion.search import find_evasions
from e2rl.scene.scene import SceneSet
from e2rl.sim.env import SimSettings


def solvable(traffic: Mapping[str, Tensor], scenes: SceneSet, sim: SimSettings) -> Tensor:
    """Bool [S] of synthesized traffic: the ego was not hit, or a search with full knowledge of the others' motion finds
    an evasion (e2rl.evasion)."""
    keep = ~traffic["contact"].cpu()
    hit = (~keep).nonzero()[:, 0]
    if len(hit):
        states, valid = (traffic[name].cpu()[hit] for name in ("states", "valid"))
        keep[hit] = find_evasions(scenes.batch(traffic["scene_index"].cpu()[hit]), states, valid, sim).found.cpu()
    return keep
