"""An adversary: the vehicle ahead of the ego brakes on its recorded path, everybody
else replays the log."""

import torch
from tensordict import TensorDict

from e2rl.metrics.preventable import poses
from e2rl.scenes.boxes import to_frame
from e2rl.scenes.recording import DT
from e2rl.traffic.rule_based import LogReplay
from e2rl.traffic.traffic import steps_ahead


class BrakingLeader(LogReplay):
    """The nearest vehicle ahead, within `reach` m and half a lane beside, brakes at eta
    times `braking` m/s^2."""

    replays_log, adversarial = False, True

    def __init__(self, prior, reach, braking):
        self.reach = reach
        self.braking = braking

    def reset(self, scenes, seed, eta):
        """Who brakes, and how hard."""
        vehicles = scenes["route_log"].shape[1]
        start = scenes["start"][:, :vehicles]
        x, y = to_frame(start[..., :2], start[:, :1]).unbind(-1)
        ahead = (
            scenes["valid"][:, :vehicles]
            & (start[..., 3] > 1)
            & (x > 0)
            & (x < self.reach)
            & (y.abs() < 1.8)
        )
        nearest = x == x.masked_fill(~ahead, torch.inf).amin(1, keepdim=True)
        leader = ahead & nearest & (eta > 0)[:, None]
        return TensorDict(
            {"leader": leader, "braking": self.braking * eta}, batch_size=eta.shape
        )

    def replan(self, state, world, ego_plan):
        """The log, but for the leader: where its braked distance is on its recorded
        path."""
        state, plan = super().replan(state, world, ego_plan)
        vehicles = plan.states.shape[1]
        leader = state["leader"]
        path = world.scene["logged"][:, :, :vehicles].transpose(1, 2)  # [B, V, T+1, 4]
        first = path[:, :, 0, 3].clamp(min=0.1)[..., None]
        braking = state["braking"][:, None, None].clamp(min=1e-3)
        time = torch.minimum(
            DT * steps_ahead(world)[:, None], first / braking
        )  # until the halt
        gone = first * time - braking * time**2 / 2
        pose = poses(path.flatten(0, 1), gone.flatten(0, 1)).view(*gone.shape, 3)
        braked = torch.cat([pose, (first - braking * time)[..., None]], -1)
        plan.states = torch.where(leader[..., None, None], braked, plan.states)
        plan.present = plan.present | (leader & world.valid[:, :vehicles])[..., None]
        plan.adversary = leader
        return state, plan
