"""A driver learned by bi-level imitation, in the manner of BITS (Xu et al. 2023):
goals, plans to them, the best plan.

Upper level: a distribution over goals beside the mission, of which `goals` are drawn.
Lower level: a goal-conditioned policy plans to each of them, driven by the unicycle.
The plan that costs least on a forecast of the others is chosen.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.planners.bits_network import (
    CELLS,
    BitsNetwork,
    drive_controls,
    load_bits,
    place,
)
from e2rl.planners.candidates import Candidates
from e2rl.planners.chunks import PLANNER_KEYS
from e2rl.planners.path import MissionPath
from e2rl.planners.sampling import ScoringEgo
from e2rl.run.config import configured, setting
from e2rl.sim.mission import mission_of
from e2rl.sim.observation import ELAPSED, features, placed_ego
from e2rl.sim.static import static_scene
from e2rl.sim.world import World

LOG_KEYS = ("logged", "logged_valid")  # for `static_scene`; no feature shows them


@configured("ego/bits")
@dataclass(eq=False)
class BitsEgo(ScoringEgo):
    """Drives by the cheapest of the plans to goals that recorded drivers might have
    had."""

    READS = (*PLANNER_KEYS, *LOG_KEYS)
    tuned = {"goals": (10, 80), "temperature": (0.3, 2.0)} | ScoringEgo.tuned

    checkpoint: str | None = setting()
    goals: int = setting(low=1, high=CELLS)
    temperature: float = setting(low=1e-3)

    def __post_init__(self) -> None:
        """Raises InputError for a checkpoint that is missing or does not fit."""
        if self.checkpoint is None:
            self.network = BitsNetwork().eval()
        else:
            self.network = load_bits(self.checkpoint)
        uniform = torch.rand(CELLS, generator=torch.Generator().manual_seed(0))
        self.noise = -(-uniform.clamp(1e-6, 1 - 1e-6).log()).log()  # Gumbel's

    @torch.no_grad()
    def candidates(self, world: World) -> Candidates:
        """Plans to `goals` goals of each scene."""
        path = MissionPath(world)
        start = world.states[:, 0]
        speed = start[:, 3]
        network = self.network.to(start.device)
        code = network.encode(observed(world))
        distance, side = self.drawn(*network.goals(code), speed)
        stop = path.stop_distance().clamp(min=0)
        controls = network.controls(
            code,
            speed=speed,
            offset=path.d,
            distance=torch.minimum(distance, stop[:, None]),
            side=side,
        )
        return drive_controls(
            controls,
            start,
            path=path,
        )

    def drawn(
        self,
        logits: Tensor,
        residual: Tensor,
        speed: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Distances and sides [B, goals] m of goals drawn without replacement (the
        Gumbel-max trick).

        The noise is the same in every scene and replan, so a plan depends on nothing
        but its World.
        """
        noisy = logits / self.temperature + self.noise.to(logits.device)
        cell = noisy.topk(self.goals, 1).indices
        inside = residual.gather(1, cell[..., None].expand(-1, -1, 2))
        return place(speed, cell, residual=inside)


def observed(world: World) -> Tensor:
    """The environment's observations [B, D] of Worlds, but for the elapsed time, which
    is 0."""
    static = static_scene(world.scene, mission_of(world.scene))
    state = world.states[:, 0]
    present = world.valid[:, 0]
    ego = placed_ego(
        static.mission,
        state,
        step=world.step,
        action=world.ego_action(),
        present=present,
        place=world.mission_s,
        others=static.vehicle,
    )
    observation = features(static, ego, world.others(), world.step.to(state.dtype))
    elapsed = torch.tensor([ELAPSED], device=state.device)
    return observation.index_fill(1, elapsed, 0.0)
