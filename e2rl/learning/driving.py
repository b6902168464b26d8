"""One drive through each row of a pool: for planners' tuning, for expert pairs, for before and after."""

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from tqdm import tqdm

from e2rl.ego.base import Ego, EgoPolicy
from e2rl.ego.reference import executed_action
from e2rl.learning.episodes import Episodes
from e2rl.learning.pool import TrafficPool
from e2rl.sim.env import DrivingEnv

Disturbance = Callable[[Tensor, int], Tensor]  # (action [B, 2], step) -> the action [B, 2] executed instead


def drive(env: DrivingEnv, ego: Ego, pool: TrafficPool, rows: Tensor, disturb: Disturbance | None = None) -> TensorDict:
    """One episode in each of pool rows [B] with `ego` at the wheel; B is the environment's batch.

    Returns [B, T]: observation, intended (the ego's action), executed (after disturbance and bounds) [.., 2], alive
    (the step belongs to the episode), reward, contact, off_road, progress. The environment restarts all scenes.
    """
    places, policy, frames = torch.arange(len(rows), device=env.device), EgoPolicy(ego, env), []
    pool.inject(env, places, rows)
    td = env.reset(TensorDict({"scene_index": pool.scene_index[rows][:, None].to(env.device)}, env.batch_size))
    alive = torch.ones(len(rows), dtype=torch.bool, device=env.device)
    for step in range(env.horizon):
        intended = policy(td)["action"]
        if disturb is not None:
            td["action"] = disturb(intended, step)
        after = env.step(td)["next"]
        frames.append(_frame(td, after, intended, alive))
        alive = alive & ~after["done"][:, 0]
        td = after.exclude("reward")
        if not alive.any():
            break
    return torch.stack(frames, 1)


def _frame(td: TensorDictBase, after: TensorDictBase, intended: Tensor, alive: Tensor) -> TensorDict:
    metrics = after["metrics"]
    return TensorDict(
        {
            "observation": td["observation"],
            "intended": intended,
            "executed": executed_action(after["observation"]),
            "alive": alive,
            "reward": after["reward"][:, 0] * alive,
            "off_road": metrics["off_road"][:, 0] & alive,
            "contact": (metrics["contact"] | metrics["contact_vru"])[:, 0] & alive,
            "progress": metrics["progress"][:, 0],
        },
        batch_size=alive.shape,
        device=alive.device,
    )


def episodes_of(frames: TensorDictBase, pool: TrafficPool, rows: Tensor) -> Episodes:
    """Outcomes [B] of a `drive`."""
    frames, count = frames.to("cpu"), frames["alive"].sum(1).cpu()
    last = frames["progress"].gather(1, (count - 1)[:, None])[:, 0]
    effort = (frames["executed"][..., 0].abs() * frames["alive"]).sum(1) / count
    return Episodes(
        row=rows,
        scene_index=pool.scene_index[rows],
        adversarial=pool.adversarial[rows],
        contact=frames["contact"].any(1),
        off_road=frames["off_road"].any(1),
        returns=frames["reward"].sum(1),
        progress=last,
        acceleration=effort,
    )


def drive_all(env: DrivingEnv, ego: Ego, pool: TrafficPool, label: str = "") -> Episodes:
    """Outcomes of one drive in every row of the pool, in order; a progress bar is shown for a non-empty label."""
    batch, parts = env.batch_size[0], []
    for first in tqdm(range(0, len(pool), batch), label, disable=not label, unit="batch", leave=False):
        wanted = torch.arange(first, min(first + batch, len(pool)))
        rows = torch.cat([wanted, wanted[-1:].expand(batch - len(wanted))])
        parts.append(_kept(episodes_of(drive(env, ego, pool, rows), pool, rows), len(wanted)))
    return joined(parts)


def joined(parts: list[Episodes]) -> Episodes:
    """All episodes of the parts, in order."""
    return Episodes(*(torch.cat([getattr(part, name) for part in parts]) for name in Episodes.__dataclass_fields__))


def _kept(episodes: Episodes, count: int) -> Episodes:
    return Episodes(*(getattr(episodes, name)[:count] for name in Episodes.__dataclass_fields__))
