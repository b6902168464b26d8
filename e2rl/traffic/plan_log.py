"""The plans of a rollout, thinned out for its file: where everybody meant to go, and whom adversaries aimed at."""

import torch
from torch import Tensor

from e2rl.traffic.traffic import REPLAN_STEPS, TrafficPlan

POINT_STEPS = 5  # steps between two kept points of a plan: 0.5 s


class PlanLog:
    """Collects the plans of B scenes that replan at the same steps, every REPLAN_STEPS from the start on."""

    def __init__(self) -> None:
        self.paths: list[Tensor] = []
        self.targets: list[Tensor] = []

    def __call__(self, plan: TrafficPlan) -> None:
        """Note a plan of all scenes (`AdversarialSynthesizer.on_plan`)."""
        nobody = torch.full(plan.states.shape[:2], -1, dtype=torch.int64)
        self.paths.append(points_of(plan.states).cpu())
        self.targets.append(nobody if plan.target is None else plan.target.cpu())

    def tensors(self, ego_plans: Tensor) -> dict[str, Tensor]:
        """`plans` [B, R, V, K, 2] m, at POINT_STEPS, 2 POINT_STEPS .. steps after each of R replans, and `targets`
        [B, R, V] (0 the ego, -1 nobody). Row 0 is the ego's plan, from ego_plans [B, T, H, 4] at every step."""
        plans = torch.stack(self.paths, 1)
        plans[:, :, 0] = points_of(ego_plans[:, ::REPLAN_STEPS]).cpu()
        return {"plans": plans, "targets": torch.stack(self.targets, 1)}


def points_of(states: Tensor) -> Tensor:
    """Positions [..., K, 2] of states [..., H, 4] at every POINT_STEPS-th planned step."""
    return states[..., POINT_STEPS - 1 :: POINT_STEPS, :2]
