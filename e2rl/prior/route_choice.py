"""Which way a vehicle goes: a distribution over its route candidates."""

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from e2rl.scene.recording import LIGHT_GREEN, LIGHT_RED
from e2rl.scene.route import SPACING, interpolate, project
from e2rl.sim.dynamics import wrap

FEATURES = 16
PROBES = (10.0, 20.0, 35.0, 55.0, 80.0)  # m ahead where the turn is looked at


def candidate_features(scene: TensorDictBase) -> Tensor:
    """[B, V, R, FEATURES] of each route candidate as seen from the vehicle's start state."""
    points = scene["route_points"]
    vehicles = points.shape[1]
    start = scene["start"][:, :vehicles]
    s, d, heading = (value[..., 0] for value in project(start[:, :, None, None, :2], points))
    v = start[..., 3][..., None].expand_as(s)
    at = s[..., None] + torch.tensor((0.0, *PROBES), device=s.device)
    angle = interpolate(points, at)[1]
    turn = wrap(angle[..., 1:] - angle[..., :1])
    curvature = turn.abs().diff(dim=-1, prepend=torch.zeros_like(turn[..., :1])).abs()
    tight = (curvature / torch.tensor([10.0, 10.0, 15.0, 20.0, 25.0], device=s.device)).amax(-1)
    excess = (v**2 * tight / 4 - 1).clamp(0, 4)
    limit = scene["route_limit"].gather(-1, (s / SPACING).long().clamp(0, points.shape[3] - 1)[..., None])[..., 0]
    light = scene["route_light"][..., 0]
    states = scene["light_state"][:, 0]
    if states.shape[-1]:
        colour = states[:, None, None].expand(*light.shape, -1).gather(-1, light.clamp(min=0)[..., None])[..., 0]
    else:
        colour = torch.zeros_like(light)
    seen = light >= 0
    rank = torch.arange(s.shape[-1], device=s.device).expand_as(s)
    yaw_rate = scene["start_yaw_rate"][:, :vehicles, None].expand_as(s)
    rest = (scene["route_length"] - s).clamp(0, 100) / 50
    bend = (yaw_rate / v.clamp(min=2.0) - turn[..., 0] / 10.0) * 10
    return torch.stack(
        [
            d.abs(),
            d,
            wrap(start[..., 2][..., None] - heading) * 3,
            *turn.unbind(-1),
            rest,
            v / 10,
            excess,
            bend,
            (seen & (colour == LIGHT_GREEN)).float(),
            (seen & (colour == LIGHT_RED)).float(),
            rank / 3,
            (v - limit) / 10,
        ],
        -1,
    )


class RouteChoice(nn.Module):
    """Logits over a vehicle's candidates from their features."""

    def __init__(self, width: int = 64):
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(FEATURES, width), nn.GELU(), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1)
        )

    def forward(self, scene: TensorDictBase) -> Tensor:
        """Logits [B, V, R]; -inf where there is no candidate, but for candidate 0 of a vehicle without any."""
        logits = self.net(candidate_features(scene))[..., 0]
        valid = scene["route_valid"].clone()
        valid[..., 0] |= ~valid.any(-1)
        return logits.masked_fill(~valid, -torch.inf)


def sample_route(logits: Tensor, temperature: float, uniform: Tensor) -> Tensor:
    """A candidate [...] of logits [..., R] for each uniform number [...] in [0, 1), by the inverse of the distribution
    function; temperature 0: the most likely."""
    if temperature <= 0:
        return logits.argmax(-1)
    total = torch.softmax(logits / temperature, -1).cumsum(-1)
    below = uniform.clamp(max=1 - 1e-6)[..., None] * total[..., -1:]  # never past the last possible one
    return (total <= below).sum(-1)
