"""A driver learned by bi-level imitation, in the manner of BITS (Xu et al. 2023): goals, plans to them, the best plan.

Upper level: a distribution over goals beside the mission, of which `goals` are drawn. Lower level: a goal-conditioned
policy plans to each of them, driven by the unicycle. The plan that costs least on a forecast of the others is chosen.
"""

import torch
from torch import Tensor

from e2rl.planners.bits_network import CELLS, BitsNetwork, drive_controls, load_bits, place
from e2rl.planners.candidates import Candidates
from e2rl.planners.path import MissionPath
from e2rl.planners.sampling import SCENE_KEYS, Outlook, ScoringEgo
from e2rl.planners.scoring import Weights
from e2rl.run.errors import InputError
from e2rl.scenes.route import project
from e2rl.sim.mission import mission_of
from e2rl.sim.observation import ELAPSED, EgoState, observation_config, observe
from e2rl.sim.static import FrenetPose, static_scene
from e2rl.sim.world import Agents, World

STOP_GAP = 1.0  # m kept to a stop line


class BitsEgo(ScoringEgo):
    """Drives by the cheapest of the plans to goals that recorded drivers might have had."""

    READS = (*SCENE_KEYS, "agent_type", "logged", "logged_valid")  # `static_scene` wants the log; no feature shows it

    def __init__(
        self,
        checkpoint: str | None = "bundled",
        goals: int = 40,
        temperature: float = 1.0,
        horizon: float = 4.0,
        agents: int = 10,
        hold: float = 1.0,
        turn: float = 1.5,
        margin: float = 0.5,
        margin_growth: float = 0.2,
        headway: float = 1.5,
        rear: float = 0.5,
        fade: float = 0.15,
        contact: float = 200.0,
        near: float = 30.0,
        border: float = 0.5,
        off_road: float = 20.0,
        progress: float = 0.2,
        comfort: float = 1.0,
        aside: float = 2.0,
        braking: float = 3.0,
        obey_lights: bool = True,
        see_vrus: bool = True,
        seed: int = 0,
        replan_every: int = 5,
    ) -> None:
        """Fields: conf/ego/bits.yaml. Raises InputError for a checkpoint that is missing or does not fit."""
        if not 1 <= goals <= CELLS:
            raise InputError(f"ego.goals={goals}: the grid has {CELLS} goals; choose 1 to {CELLS}")
        weights = Weights(
            margin, margin_growth, headway, rear, fade, contact, near, border, off_road, progress, comfort, aside
        )
        super().__init__(Outlook(horizon, int(agents), hold, turn, see_vrus), weights, replan_every)
        self.network = BitsNetwork().eval() if checkpoint is None else load_bits(checkpoint)
        self.goals, self.temperature = int(goals), temperature
        self.braking, self.obey_lights = braking, obey_lights
        uniform = torch.rand(CELLS, generator=torch.Generator().manual_seed(seed))
        self.noise = -(-uniform.clamp(1e-6, 1 - 1e-6).log()).log()  # Gumbel's

    @torch.no_grad()
    def candidates(self, world: World) -> Candidates:
        """Plans to `goals` goals of each scene."""
        path, start = MissionPath(world), world.states[:, 0]
        network = self.network.to(start.device)
        code = network.encode(observed(world))
        way, side = self.drawn(*network.goals(code), start[:, 3])
        if self.obey_lights:
            way = torch.minimum(way, path.stop_distance(self.braking, STOP_GAP).clamp(min=0)[:, None])
        return drive_controls(network.controls(code, start[:, 3], path.d, way, side), start, path)

    def drawn(self, logits: Tensor, residual: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Ways and sides [B, goals] m of goals drawn without replacement (the Gumbel-max trick).

        The noise is the same in every scene and replan, so a plan depends on nothing but its World.
        """
        cell = (logits / self.temperature + self.noise.to(logits.device)).topk(self.goals, 1).indices
        return place(speed, cell, residual.gather(1, cell[..., None].expand(-1, -1, 2)))


def observed(world: World) -> Tensor:
    """The environment's observations [B, D] of Worlds, but for the elapsed time, which is 0."""
    static, state = static_scene(world.scene, mission_of(world.scene)), world.states[:, 0]
    pose = FrenetPose(*(value[:, 0] for value in project(state[:, None, :2], static.mission.points)))
    assert world.turn_rate is not None
    action, present = torch.stack([world.accel[:, 0], world.turn_rate[:, 0]], -1), world.valid[:, 0]
    ego = EgoState(world.step, state, action, pose, present, present, pose.s)
    others = Agents(*(value[:, 1:] for value in (world.states, world.valid, world.accel, world.turn_rate)))
    features = observe(observation_config(state.device), static, ego, others, 1).features
    return features.index_fill(1, torch.tensor([ELAPSED], device=state.device), 0.0)
