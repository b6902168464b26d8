"""Paths along routes for planners: a smooth return from the vehicle's pose to the
route, and speed caps by curves, limits and lights.
"""

import torch
from torch import Tensor

from e2rl.planners.ego import return_length
from e2rl.scenes.recording import DT
from e2rl.scenes.route import SPACING, interpolate, project
from e2rl.sim.dynamics import wrap
from e2rl.sim.mission import light_state_at, limit_at, mission_of, stop_line_distance
from e2rl.sim.world import World

MAX_SLOPE = (
    1.0  # rad, bound of the angle between vehicle and route at the start of a path
)
CAPPED_AHEAD = 200.0  # m of speed caps
LATERAL_ACCELERATION = 3.0  # m/s^2 that curves are taken with
BRAKING = 3.0  # m/s^2 ahead of curves, limits and lights
STOP_GAP = 1.0  # m kept to a stop line


class RoutePath:
    """Paths of vehicles [...] that start at their pose, along their heading, and return
    to a route.

    At arc length s + a of the route (a metres ahead) the lateral offset is d(a) = (d0 +
    (m + d0 / l) a) exp(-a / l), m the slope of the heading to the route, l =
    return_length(speed): the critically damped return. It solves a linear equation in
    a, so a replan on the curve gives the same curve. The offset * exp(-a^2 / 3.5^2) of
    STRIVE's planner (Rempe et al. 2022) starts with a kink that no car can drive.
    """

    def __init__(
        self, state: Tensor, route: Tensor, place: Tensor | None = None
    ) -> None:
        """state [..., 4], route [..., P, 2]; place [...]: arc length [m] near which the
        vehicles are, where known."""
        self.route = route
        hint = None if place is None else place[..., None]
        s, d, heading = (
            value[..., 0] for value in project(state[..., None, :2], route, hint=hint)
        )
        self.s = s
        self.d = d
        self.turned = wrap(state[..., 2] - heading)
        self.length = return_length(state[..., 3])
        self.residual = torch.zeros_like(state[..., :2])
        self.residual = (
            state[..., :2] - self.at(torch.zeros_like(s)[..., None])[..., 0, :2]
        )

    def offset(self, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """Lateral offset and its slope at `ahead` [..., K] metres along the route."""
        return fading(
            self.d[..., None],
            self.turned[..., None],
            length=self.length[..., None],
            ahead=ahead,
        )

    def at(self, ahead: Tensor) -> Tensor:
        """Poses [..., K, 3] at `ahead` [..., K] metres along the route."""
        xy, heading, curvature = interpolate(self.route, self.s[..., None] + ahead)
        offset, slope = self.offset(ahead)
        normal = torch.stack([-heading.sin(), heading.cos()], -1)
        fading = (
            torch.exp(-ahead.clamp(min=0) / self.length[..., None])[..., None]
            * self.residual[..., None, :]
        )
        turn = torch.atan2(slope, (1 - curvature * offset).clamp(min=0.2))
        return torch.cat(
            [xy + offset[..., None] * normal + fading, wrap(heading + turn)[..., None]],
            -1,
        )

    def ahead(self, distance: Tensor) -> Tensor:
        """Metres along the route [..., K] after driving `distance` [..., K] (growing,
        from 0) along the path."""
        _, _, curvature = interpolate(self.route, self.s[..., None] + distance)
        offset, slope = self.offset(distance)
        stretch = torch.hypot((1 - curvature * offset).clamp(min=0.2), slope)
        step = distance.diff(dim=-1, prepend=torch.zeros_like(distance[..., :1]))
        return (step / stretch).cumsum(-1)

    def drive(self, speed: Tensor) -> Tensor:
        """States [..., H, 4] at steps 1..H of DT for speeds [..., H + 1] at steps 0..H
        (0: now)."""
        distance = ((speed[..., 1:] + speed[..., :-1]) / 2 * DT).cumsum(-1)
        return torch.cat([self.at(self.ahead(distance)), speed[..., 1:, None]], -1)


def fading(
    d: Tensor, turned: Tensor, length: Tensor, ahead: Tensor
) -> tuple[Tensor, Tensor]:
    """Offset [m] and its slope, both of the shape that the arguments broadcast to,
    `ahead` m after an offset d m and a heading `turned` rad off the route: the
    critically damped return over `length` m (`RoutePath`)."""
    slope = torch.tan(turned.clamp(-MAX_SLOPE, MAX_SLOPE))
    rate = slope + d / length
    decay = torch.exp(-ahead.clamp(min=0) / length)
    return (d + rate * ahead) * decay, (slope - rate * ahead / length) * decay


class MissionPath(RoutePath):
    """The ego's path along its mission in the Worlds of B scenes."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.mission = mission_of(world.scene)
        super().__init__(world.states[:, 0], self.mission.points, world.mission_s)

    def speed_caps(
        self,
        desired: float,
        braking: float = BRAKING,
        limits: bool = True,
        lights: bool = True,
    ) -> Tensor:
        """Squares [B, CAPPED_AHEAD / SPACING] of the highest speeds every SPACING
        metres ahead; read them by `look_up`.

        From these speeds, braking at `braking` m/s^2 meets all limits: `desired` m/s,
        or the speed limit where it is known and `limits`; LATERAL_ACCELERATION in
        curves; with `lights` a halt before a light that binds (negative beyond it).
        c(a)^2 = min over b >= a of v(b)^2 + 2 braking (b - a), which is piecewise
        linear in a.
        """
        count = int(CAPPED_AHEAD / SPACING)
        grid = SPACING * torch.arange(count, device=self.s.device, dtype=self.s.dtype)
        at = self.s[:, None] + grid
        curvature = torch.nn.functional.avg_pool1d(
            interpolate(self.mission.points, at)[2], 3, 1, 1
        )
        speed = torch.sqrt(
            LATERAL_ACCELERATION / curvature.abs().clamp(min=1e-4)
        ).clamp(max=1e3)
        limit = limit_at(self.mission, at) if limits else torch.zeros_like(at)
        squared = torch.minimum(speed, torch.where(limit > 0, limit, desired)) ** 2
        potential = (squared + 2 * braking * grid).flip(-1).cummin(-1).values.flip(-1)
        if lights:
            halt = self.stop_distance(braking)[:, None]
            potential = torch.minimum(potential, 2 * braking * halt)
        return potential - 2 * braking * grid

    def stop_distance(self, braking: float = BRAKING) -> Tensor:
        """Metres [B] until the ego's front is STOP_GAP m before the next stop line that
        binds; negative beyond that point, inf for none. A yellow light binds if
        `braking` m/s^2 halts before it, a red one if twice as much does.
        """
        scene = self.world.scene
        mission = self.mission
        lights = light_state_at(
            scene["light_state"], mission.light, step=self.world.step
        )
        ahead = mission.light_s
        speed = self.world.states[:, 0, 3]
        line = stop_line_distance(
            lights,
            ahead - self.s[:, None],
            speed=speed,
            red_braking=2 * braking,
            yellow_braking=braking,
        )
        return line - scene["size"][:, 0, 0] / 2 - STOP_GAP


def look_up(caps: Tensor, ahead: Tensor) -> Tensor:
    """Speeds [B, ...] of the squared caps of `speed_caps` at `ahead` [B, ...] metres;
    the last cap is held."""
    low, high, fraction = between_entries(caps, ahead / SPACING)
    return (low + fraction * (high - low)).clamp(min=0).sqrt()


def between_entries(table: Tensor, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The entries of a table [B, K] before and after places `at` [B, ...], in entries,
    and the fraction of the distance between them; outside of the table, its first and
    last."""
    at = at.clamp(0, table.shape[-1] - 1.001)
    index = at.long()
    flat = index.flatten(1)
    low, high = (table.gather(1, flat + shift).view(at.shape) for shift in (0, 1))
    return low, high, at - index
