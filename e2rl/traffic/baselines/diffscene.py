"""DiffScene (Xu et al. 2025): one adversary, generated once by three objectives and
driven open loop."""

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Context
from e2rl.run.config import configured, setting
from e2rl.scenes.route import project
from e2rl.traffic.baselines.guidance import CleanGuidance, guided_samples
from e2rl.traffic.baselines.losses import (
    approach_term,
    comfort_term,
    even,
    off_road_term,
    off_route_term,
    speeding_term,
)
from e2rl.traffic.baselines.open_loop import OpenLoop, Scenario
from e2rl.traffic.baselines.view import View, pick
from e2rl.traffic.motion import smallest
from e2rl.traffic.nominal import Replan

LOW = -3.5  # m/s^2 that the constraint lets pass
HIGH = 2.0  # m/s^2
JERK = 2.0  # m/s^3
CORRIDOR = 1.0  # m beside the ego's route in which an adversary obstructs it


@configured("synthesizer/diffscene")
@dataclass(eq=False, repr=False)
class DiffScene(OpenLoop):
    """Clean guidance of the vehicle nearest to the ego by safety, functionality and
    constraint; others by the prior."""

    step_size: float = setting(low=0)
    clip: float = setting(low=0)
    samples: int = setting(low=1)
    safety: float = setting()
    functionality: float = setting()
    constraint: float = setting()
    temperature: float = setting(low=1e-3)

    tuned = {"gain": (0.2, 20.0, "log"), "step_size": (0.2, 20.0, "log")}

    def scenario(
        self,
        replan: Replan,
        context: Context,
        nominal: Tensor,
    ) -> Scenario:
        """The guided joint sample of least loss; the adversary alone is held."""
        strength = self.strength(replan.state)
        view = View.of(replan, context, strength)
        adversary = smallest(view.active, view.distance_to_ego(), count=1)
        adversary = adversary & (strength > 0)[:, None]
        loss = partial(self.loss, view=replace(view, adversary=adversary))
        samples = guided_samples(
            self.prior,
            replan,
            context,
            loss=loss,
            control=partial(
                CleanGuidance,
                guided=adversary.repeat(self.samples, 1),
                step_size=self.step_size,
                clip=self.clip,
            ),
        )
        index = loss(samples.motion).sum(-1).argmin(0)
        return Scenario(
            pick(samples.x0, index),
            adversary,
            adversary=adversary,
            path_kl=pick(samples.kl, index),
        )

    def loss(self, motion: LaneState, view: View) -> Tensor:
        """The three objectives of the adversary; 0 for others."""
        states = view.with_ego(motion)
        safety = approach_term(states, self.temperature)
        functionality = corridor_term(states, view)
        attack = self.safety * safety + self.functionality * functionality
        lawful = off_route_term(motion, view)
        lawful = lawful + comfort_term(
            motion,
            low=LOW,
            high=HIGH,
            jerk=JERK,
        )
        lawful = lawful + off_road_term(states, view, weights=even(states))
        lawful = lawful + speeding_term(motion, view)
        total = view.strength[:, None] * attack + self.constraint * lawful
        return total * view.adversary


def corridor_term(states: Tensor, view: View) -> Tensor:
    """Metres [S, B, V] of the adversary beyond CORRIDOR from the ego's route, mean over
    time; 0 for others."""
    scene = torch.arange(states.shape[1], device=states.device)
    adversary = view.adversary.long().argmax(-1)
    xy = states[:, scene, adversary, :, :2]
    offset = project(xy, view.routed.points[:, 0])[1].abs()
    return (offset - CORRIDOR).clamp(min=0).mean(-1)[..., None] * view.adversary
