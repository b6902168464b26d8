"""The input of planners and traffic methods: the current state of a batch of running scenes."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor


@dataclass
class World:
    """The current state of B scenes; agent 0 is the ego, agents [:V] are the vehicles.

    scene: Scene TensorDict [B]; step [B] int64: simulated steps since the start frame; states [B, N, 4]: x, y, heading,
    speed; valid [B, N]: present now; accel [B, N] m/s^2; plan [B, V, H, 4]: the vehicles' planned
    states at the coming steps (None: unknown); route [B, V] int64: the route candidates that the vehicles follow (None:
    unknown); turn_rate [B, N] rad/s: over the last step, the ego's as executed (None: unknown).
    """

    scene: TensorDictBase
    step: Tensor
    states: Tensor
    valid: Tensor
    accel: Tensor
    route: Tensor | None = None
    plan: Tensor | None = None
    turn_rate: Tensor | None = None

    @classmethod
    def at_start(cls, scene: TensorDictBase) -> "World":
        """Scenes [B] at their start frames."""
        step = torch.zeros(scene.batch_size[0], dtype=torch.int64, device=scene["start"].device)
        start, valid, accel = (scene[key] for key in ("start", "valid", "start_accel"))
        return cls(scene, step, start, valid, accel, scene["route_log"], turn_rate=scene["start_yaw_rate"])

    @classmethod
    def of(cls, tensordict: TensorDictBase, scene: TensorDictBase) -> "World":
        """The World that a DrivingEnv with `agents=True` reports in a TensorDict [B]; scene: `DrivingEnv.scene`."""
        agents = tensordict["agents"]
        return cls(
            scene,
            tensordict["timestep"][:, 0],
            agents["states"],
            agents["valid"],
            agents["accel"],
            plan=tensordict.get(("traffic", "plan"), None),
            turn_rate=agents["turn_rate"],
        )
