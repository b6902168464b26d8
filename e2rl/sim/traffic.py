"""The trajectories of everyone but the ego: the recording, given ones, or a planner's, overwritten as it re-plans."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.errors import InputError
from e2rl.scene.recording import DT


class Traffic:
    """Trajectories states [B, T+1, N, 4], valid [B, T+1, N] of B running scenes and the candidates followed.

    route [B, V]. Vehicles (the first V rows) may be overwritten; the other rows always replay the log.
    """

    def __init__(self, scene: TensorDictBase) -> None:
        self.states, self.valid = scene["logged"].clone(), scene["logged_valid"].clone()
        self.route = scene["route_log"].clone()
        self._scheduled: list[tuple[Tensor, Tensor, Tensor, Tensor | None]] = []
        self._plan: tuple[Tensor, Tensor] | None = None

    def schedule(self, rows: Tensor, states: Tensor, valid: Tensor, route: Tensor | None) -> None:
        """Trajectories of scenes rows [b] from their coming reset on; raises InputError on a wrong shape or NaN."""
        expected = (len(rows), *self.states.shape[1:])
        if tuple(states.shape) != expected or tuple(valid.shape) != expected[:-1]:
            raise InputError(
                f"set_traffic: states {tuple(states.shape)} and valid {tuple(valid.shape)} for "
                f"{len(rows)} rows; expected {expected} and {expected[:-1]}"
            )
        if not torch.isfinite(states[valid]).all():
            raise InputError("set_traffic: NaN or infinite states marked valid; mark them invalid")
        device = self.states.device
        self._scheduled.append(
            tuple(value if value is None else value.to(device) for value in (rows, states, valid, route))
        )

    def reset(self, scene: TensorDictBase, index: Tensor) -> None:
        """Scenes index [b] begin anew: with what was scheduled for them, else with their recording; plans are void."""
        if len(index) == len(self.states):
            self.states.copy_(scene["logged"]), self.valid.copy_(scene["logged_valid"])
        else:
            self.states[index], self.valid[index] = scene["logged"][index], scene["logged_valid"][index]
        self.route[index] = scene["route_log"][index]
        vehicles, kept = self.route.shape[1], []
        for rows, states, valid, route in self._scheduled:
            now = torch.isin(rows, index)
            here = rows[now]
            self.states[here, :, :vehicles] = states[now][:, :, :vehicles].to(self.states.dtype)
            self.valid[here, :, :vehicles] = valid[now][:, :, :vehicles]
            if route is not None:
                self.route[here] = route[now]
            rest = (rows[~now], states[~now], valid[~now], None if route is None else route[~now])
            kept += [rest] if len(rest[0]) else []
        self._scheduled, self._plan = kept, None

    def write(self, step_from: Tensor, states: Tensor, valid: Tensor, route: Tensor | None) -> None:
        """Overwrite the vehicles at steps step_from [B] + 1 .. + h by states [B, h, N, 4], valid [B, h, N]."""
        batch, steps, vehicles = *self.states.shape[:2], self.route.shape[1]
        at = torch.arange(steps, device=self.states.device) - step_from[:, None] - 1
        inside = (at >= 0) & (at < states.shape[1])
        at, row = at.clamp(0, states.shape[1] - 1), torch.arange(batch, device=at.device)[:, None]
        chosen = inside[..., None, None]
        old, known = self.states[:, :, :vehicles], self.valid[:, :, :vehicles]
        moved = torch.where(chosen, states[row, at, :vehicles].to(old.dtype), old)
        seen = torch.where(chosen[..., 0], valid[row, at, :vehicles], known)
        self.states = torch.cat([moved, self.states[:, :, vehicles:]], 2)
        self.valid = torch.cat([seen, self.valid[:, :, vehicles:]], 2)
        self.route = self.route if route is None else route
        self._plan = (step_from, states)

    def at(self, step: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`traffic_at` step [B]."""
        return traffic_at(self.states, self.valid, step)

    def plan(self, step: Tensor) -> Tensor | None:
        """Rest [B, N, H, 4] at steps step + 1 .. of the last plan written, its last state held; None without one."""
        if self._plan is None:
            return None
        since, states = self._plan
        horizon = states.shape[1]
        at = (torch.arange(horizon, device=step.device) + (step - since)[:, None]).clamp(0, horizon - 1)
        row = torch.arange(len(step), device=step.device)[:, None]
        return states[row, at].transpose(1, 2)


def traffic_at(states: Tensor, valid: Tensor, step: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """States [B, N, 4], valid [B, N] and acceleration [B, N] of trajectories [B, T+1, N, 4], [B, T+1, N] at step [B].

    The acceleration is the speed difference over the last step, 0 where there was none.
    """
    row, before = torch.arange(len(step), device=step.device), (step - 1).clamp(min=0)
    now, there = states[row, step], valid[row, step]
    accel = (now[..., 3] - states[row, before, :, 3]) / DT
    return now, there, accel * (there & valid[row, before])
