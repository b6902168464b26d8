"""DiffScene (Xu et al. 2025): one adversary, generated once by three objectives and
driven open loop."""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Context
from e2rl.run.settings import configured, setting
from e2rl.scenes.route import project
from e2rl.traffic.baselines.guidance import CleanGuidance
from e2rl.traffic.baselines.losses import (
    approach_term,
    comfort_term,
    off_road_term,
    off_route_term,
    speeding_term,
)
from e2rl.traffic.baselines.open_loop import OpenLoop, OpenLoopState, Scenario
from e2rl.traffic.baselines.view import View, folded, motion_of, pick, tiled
from e2rl.traffic.motion import smallest
from e2rl.traffic.nominal import Replan

LOW, HIGH, JERK = -3.5, 2.0, 2.0  # m/s^2, m/s^2, m/s^3: what the constraint lets pass
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

    def scenario(self, now: Replan, context: Context, nominal: Tensor) -> Scenario:
        """The guided joint sample of least loss; the adversary alone is held."""
        view = View.of(now.world, context, ego_plan=now.ego_plan)
        count = now.noise.shape[3]
        adversary = (
            smallest(view.active, view.distance_to_ego(), count=1)
            & (self.strength(now.state) > 0)[:, None]
        )
        loss = partial(self.loss, state=now.state, view=view, adversary=adversary)
        control = CleanGuidance(
            self.prior,
            loss,
            guided=adversary.repeat(count, 1),
            samples=count,
            step_size=self.step_size,
            clip=self.clip,
        )
        many = tiled(context, count)
        sample = self.prior.sample(many, folded(now.noise), control)
        index = (
            loss(motion_of(self.prior, sample.x0, context=many, count=count))
            .sum(-1)
            .argmin(0)
        )
        x0, kl = (
            pick(value.unflatten(0, (count, -1)), index)
            for value in (sample.x0, sample.kl)
        )
        return Scenario(x0, adversary, adversary=adversary, path_kl=kl)

    def loss(
        self, motion: LaneState, state: OpenLoopState, view: View, adversary: Tensor
    ) -> Tensor:
        """The three objectives of the adversary [B, V]; 0 for others."""
        states = view.with_ego(motion)
        attack = self.safety * approach_term(states, self.temperature)
        attack = attack + self.functionality * corridor_term(
            states, view, adversary=adversary
        )
        even = torch.full_like(states[0, 0, 0, :, 0], 1 / states.shape[-2])
        lawful = off_route_term(motion, view) + comfort_term(
            motion, LOW, high=HIGH, jerk=JERK
        )
        lawful = (
            lawful
            + off_road_term(states, view, weights=even)
            + speeding_term(motion, view)
        )
        return (
            self.strength(state)[:, None] * attack + self.constraint * lawful
        ) * adversary


def corridor_term(states: Tensor, view: View, adversary: Tensor) -> Tensor:
    """Metres [S, B, V] of the adversary beyond CORRIDOR from the ego's route, mean over
    time; 0 for others."""
    row = adversary.long().argmax(-1)
    at = row[None, :, None, None, None].expand(len(states), -1, 1, *states.shape[-2:])
    _, offset, _ = project(
        states.gather(2, at)[:, :, 0, :, :2], view.routed.points[:, 0]
    )
    return (offset.abs() - CORRIDOR).clamp(min=0).mean(-1)[..., None] * adversary
