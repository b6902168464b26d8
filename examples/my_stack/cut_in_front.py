"""An objective of the attack: adversaries want to be just in front of their target,
instead of meeting it."""

from dataclasses import dataclass

import torch

from e2rl.run.config import configured, setting
from e2rl.scenes.boxes import to_frame
from e2rl.traffic.potentials import LENGTH, PotentialSettings, with_ego


@configured("synthesizer/e2_paper", "potentials")  # what a YAML file leaves out
@dataclass(frozen=True)
class CutInFront(PotentialSettings):
    """V_adv is the mean distance to the place `ahead` m in front of the target, in
    units of 2 m."""

    ahead: float = setting(low=0.0)

    def adversarial(self, states, context, temperature):
        """[B, V] of states [B, V, T, 4]; the ego, row 0, and the target are no part of
        the gradient."""
        states = with_ego(states, context)
        index = context.target.clamp(min=0)  # [B, V]; -1: does not act
        target = states.detach().gather(1, index[..., None, None].expand_as(states))
        place = to_frame(states[..., :2], target)  # [B, V, T, 2], x ahead of the target
        wanted = torch.tensor([self.ahead, 0.0], device=states.device)
        distance = ((place - wanted).square().sum(-1) + 1e-6).sqrt().mean(-1)
        acts = context.valid & (context.target >= 0) & context.valid.gather(1, index)
        acts[:, 0] = False
        return torch.where(acts, self.distance * distance / LENGTH, 0.0)
