"""A sampling planner: hundreds of candidates, each driven by the unicycle and scored on a forecast of the others.

Propose, simulate, score and take the best, in the manner of PDM-Closed (Dauner et al. 2023). It looks at nobody's plan.
Vectorised over scenes, candidates and agents.
"""

import torch

from e2rl.ego.candidates import Candidates, drive, speed_profiles
from e2rl.ego.path import MissionPath
from e2rl.ego.ranking import Outlook, ScoringEgo
from e2rl.ego.scoring import Weights
from e2rl.sim.world import World

PROFILES = (
    *((-8.0, -8.0), (-8.0, 0.0), (-6.0, -6.0), (-6.0, 0.0), (-6.0, 2.0), (-4.0, -4.0), (-4.0, 0.0)),
    *((-2.5, -2.5), (-2.5, 0.0), (-1.2, -1.2), (-1.2, 0.0)),
    *((0.0, 0.0), (0.0, -3.0), (0.0, -8.0), (0.0, 1.5), (1.2, 1.2), (1.2, 0.0), (1.2, -3.0)),
    *((2.5, 2.5), (2.5, 0.0), (2.5, -4.0), (4.0, 4.0), (4.0, 0.0), (4.0, -6.0), (5.0, 5.0), (5.0, -8.0)),
)  # m/s^2 in the first second and after it
SHIFTS = (0.0, 1.0, -1.0, 2.0, -2.0, 3.5, -3.5, 5.0, -5.0)  # m beside the mission, left positive
BRAKING_MORE = 1.0  # m/s^2 by which braking may exceed what the speed caps are made for


class SamplingEgo(ScoringEgo):
    """26 speed profiles on 19 lateral moves: 9 shifts beside the mission, swift and calm, and the present one."""

    CHUNK = 8  # fits the processor's cache

    def __init__(
        self,
        max_speed: float = 20.0,
        horizon: float = 4.0,
        agents: int = 10,
        hold: float = 1.0,
        turn: float = 1.5,
        swift: float = 0.7,
        calm: float = 1.4,
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
        lateral_acceleration: float = 3.0,
        braking: float = 3.0,
        max_acceleration: float = 5.0,
        max_braking: float = 8.0,
        max_yaw_rate: float = 1.6,
        use_limits: bool = True,
        obey_lights: bool = True,
        see_vrus: bool = True,
        replan_every: int = 1,
    ) -> None:
        """Fields: conf/ego/sampling.yaml."""
        weights = Weights(
            margin, margin_growth, headway, rear, fade, contact, near, border, off_road, progress, comfort, aside
        )
        super().__init__(Outlook(horizon, int(agents), hold, turn, see_vrus), weights, replan_every)
        self.max_speed, self.swift, self.calm = max_speed, swift, calm
        self.lateral_acceleration, self.braking = lateral_acceleration, braking
        self.max_acceleration, self.max_braking, self.max_yaw_rate = max_acceleration, max_braking, max_yaw_rate
        self.use_limits, self.obey_lights = use_limits, obey_lights

    def candidates(self, world: World) -> Candidates:
        """Every speed profile on every lateral move."""
        path, start = MissionPath(world), world.states[:, 0]
        caps = path.speed_caps(
            self.max_speed, self.lateral_acceleration, self.braking, self.use_limits, self.obey_lights
        )
        profiles = start.new_tensor(PROFILES).clamp(-self.max_braking, self.max_acceleration)
        speed = speed_profiles(start[:, 3], profiles, caps, self.braking + BRAKING_MORE)
        beside = start.new_tensor(SHIFTS).expand(len(start), -1)
        shift = torch.cat([beside, beside, path.d[:, None]], 1)
        time = start.new_tensor([self.swift] * len(SHIFTS) + [self.calm] * len(SHIFTS) + [self.swift])
        return drive(start, path, speed, shift[:, None], time, self.max_yaw_rate)
