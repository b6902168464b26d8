"""The observation of a mirrored scene, y to -y, from that of the scene: what was on the left is on the right."""

from functools import cache

import torch
from torch import Tensor

from e2rl.sim.observation import PROBE_X, PROBE_Y
from e2rl.sim.observation_layout import observation_layout
from e2rl.sim.prospects import ACCELERATIONS, OFFSETS

# quantities that change sign
SIDED = ("yaw_rate", "offset", "heading_sin", "curvature", "y", "velocity_y", "turn_rate")


@cache
def _mirror(device: torch.device) -> tuple[Tensor, Tensor]:
    """Whose number [D] each number becomes, and its sign [D]."""
    names = [entry.name for entry in observation_layout()]
    source = torch.arange(len(names))
    for start, end, shape in (
        ("border.", "", (len(PROBE_X), len(PROBE_Y))),
        ("manoeuvre.", ".gap", (len(ACCELERATIONS), len(OFFSETS))),
        ("manoeuvre.", ".contact", (len(ACCELERATIONS), len(OFFSETS))),
    ):
        block = [index for index, name in enumerate(names) if name.startswith(start) and name.endswith(end)]
        source[block] = torch.tensor(block).reshape(shape).flip(1).flatten()
    sign = torch.tensor([-1.0 if name.rsplit(".", 1)[1] in SIDED else 1.0 for name in names])
    return source.to(device), sign.to(device)


def mirrored(observation: Tensor) -> Tensor:
    """Observations [..., D] in a mirror; twice is none."""
    source, sign = _mirror(observation.device)
    return observation[..., source] * sign
