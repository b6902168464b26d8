"""Route choice: a distribution over each vehicle's route candidates."""

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from e2rl.scene.recording import LIGHT_GREEN, LIGHT_RED
from e2rl.scene.route import SPACING, interpolate, project
from e2rl.sim.dynamics import wrap
from e2rl.sim.traffic_light import light_state_at

FEATURES = 16
TURN_AT = (10.0, 20.0, 35.0, 55.0, 80.0)  # m ahead


def candidate_features(scene: TensorDictBase) -> Tensor:
    """[B, V, R, FEATURES] of each route candidate as seen from the vehicle's start state."""
    points = scene["route_points"]
    vehicles = points.shape[1]
    start = scene["start"][:, :vehicles]
    s, d, heading = (value[..., 0] for value in project(start[:, :, None, None, :2], points))
    v = start[..., 3][..., None].expand_as(s)
    at = s[..., None] + torch.tensor((0.0, *TURN_AT), device=s.device)
    angle = interpolate(points, at)[1]
    turn = wrap(angle[..., 1:] - angle[..., :1])
    curvature = turn.abs().diff(dim=-1, prepend=torch.zeros_like(turn[..., :1])).abs()
    tight = (curvature / torch.tensor([10.0, 10.0, 15.0, 20.0, 25.0], device=s.device)).amax(-1)
    excess = (v**2 * tight / 4 - 1).clamp(0, 4)
    limit = scene["route_limit"].gather(-1, (s / SPACING).long().clamp(0, points.shape[3] - 1)[..., None])[..., 0]
    light = scene["route_light"][..., 0]
    colour = light_state_at(scene["light_state"], light, torch.zeros(len(light), dtype=torch.long, device=s.device))
    green, red = ((light >= 0) & (colour == state) for state in (LIGHT_GREEN, LIGHT_RED))
    rank = torch.arange(s.shape[-1], device=s.device).expand_as(s)
    yaw_rate = scene["start_yaw_rate"][:, :vehicles, None].expand_as(s)
    rest = (scene["route_length"] - s).clamp(0, 100) / 50
    bend = (yaw_rate / v.clamp(min=2.0) - turn[..., 0] / 10.0) * 10
    features = [d.abs(), d, wrap(start[..., 2][..., None] - heading) * 3, *turn.unbind(-1), rest, v / 10, excess, bend]
    return torch.stack([*features, green.float(), red.float(), rank / 3, (v - limit) / 10], -1)


class RouteChoice(nn.Module):
    """Logits over a vehicle's route candidates from their features."""

    def __init__(self, width: int = 64):
        super().__init__()
        hidden = [nn.Linear(FEATURES, width), nn.GELU(), nn.Linear(width, width), nn.GELU()]
        self.net = nn.Sequential(*hidden, nn.Linear(width, 1))

    def forward(self, scene: TensorDictBase) -> Tensor:
        """Logits [B, V, R]; -inf where there is no candidate, except for candidate 0 of a vehicle without any."""
        logits = self.net(candidate_features(scene))[..., 0]
        valid = scene["route_valid"].clone()
        valid[..., 0] |= ~valid.any(-1)
        return logits.masked_fill(~valid, -torch.inf)


def sample_route(logits: Tensor, temperature: float, uniform: Tensor) -> Tensor:
    """A candidate [...] of logits [..., R] for each uniform number [...] in [0, 1), by inverting the distribution
    function; temperature 0: the most likely."""
    if temperature <= 0:
        return logits.argmax(-1)
    total = torch.softmax(logits / temperature, -1).cumsum(-1)
    below = uniform.clamp(max=1 - 1e-6)[..., None] * total[..., -1:]  # never past the last possible one
    return (total <= below).sum(-1)
