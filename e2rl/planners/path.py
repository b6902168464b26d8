"""Paths along routes for planners: a smooth return from the vehicle's pose to the
route, and speed caps by curves, limits and lights.
"""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

from e2rl.planners.ego import return_length
from e2rl.scenes.recording import DT
from e2rl.scenes.route import SPACING, interpolate, project
from e2rl.sim.dynamics import midpoints, wrap
from e2rl.sim.mission import light_state_at, limit_at, mission_of, stop_line_distance
from e2rl.sim.world import World

MAX_SLOPE = 1.0  # rad between vehicle and route at the start of a path, at most
CAPPED_AHEAD = 200.0  # m of speed caps
LATERAL_ACCELERATION = 3.0  # m/s^2 that curves are taken with
BRAKING = 3.0  # m/s^2 ahead of curves, limits and lights
STOP_GAP = 1.0  # m kept to a stop line
LEAST_STRETCH = 0.2  # of a curve's inside, which far beside a tight one would turn over


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
        self,
        state: Tensor,
        route: Tensor,
        place: Tensor | None = None,
    ) -> None:
        """state [..., 4], route [..., P, 2]; place [...]: arc length [m] near which the
        vehicles are, where known."""
        hint = None if place is None else place[..., None]
        s, d, heading = project(
            state[..., None, :2],
            route,
            hint=hint,
        )
        self.route = route
        self.s = s[..., 0]
        self.d = d[..., 0]
        self.turned = wrap(state[..., 2] - heading[..., 0])
        self.length = return_length(state[..., 3])
        self.residual = torch.zeros_like(state[..., :2])
        here = self.at(torch.zeros_like(s))[..., 0, :2]
        self.residual = state[..., :2] - here

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
        decay = torch.exp(-ahead.clamp(min=0) / self.length[..., None])
        residual = decay[..., None] * self.residual[..., None, :]
        xy = xy + offset[..., None] * normal + residual
        turn = torch.atan2(slope, (1 - curvature * offset).clamp(min=LEAST_STRETCH))
        return torch.cat([xy, wrap(heading + turn)[..., None]], -1)

    def ahead(self, distance: Tensor) -> Tensor:
        """Metres along the route [..., K] after driving `distance` [..., K] (growing,
        from 0) along the path."""
        curvature = interpolate(self.route, self.s[..., None] + distance)[2]
        offset, slope = self.offset(distance)
        inner = (1 - curvature * offset).clamp(min=LEAST_STRETCH)
        step = distance.diff(dim=-1, prepend=torch.zeros_like(distance[..., :1]))
        return (step / torch.hypot(inner, slope)).cumsum(-1)

    def drive(self, speed: Tensor) -> Tensor:
        """States [..., H, 4] at steps 1..H of DT for speeds [..., H + 1] at steps 0..H
        (0: now)."""
        distance = (midpoints(speed) * DT).cumsum(-1)
        return torch.cat([self.at(self.ahead(distance)), speed[..., 1:, None]], -1)


def fading(
    d: Tensor,
    turned: Tensor,
    *,
    length: Tensor,
    ahead: Tensor,
) -> tuple[Tensor, Tensor]:
    """Returns the offset [m] and its slope of the critically damped return
    (`RoutePath`), both of the shape that the arguments broadcast to.

    Args:
        d: m beside the route at the start.
        turned: rad off the route at the start.
        length: m over which the return leads.
        ahead: m after the start.
    """
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
        *,
        braking: float = BRAKING,
        limits: bool = True,
        lights: bool = True,
    ) -> Tensor:
        """Returns squares [B, CAPPED_AHEAD / SPACING] of the highest speeds every
        SPACING metres ahead, from which braking keeps all limits; read them by
        `look_up`.

        c(a)^2 = min over b >= a of v(b)^2 + 2 braking (b - a), which is piecewise
        linear in a. Curves are taken with LATERAL_ACCELERATION.

        Args:
            desired: m/s where no limit is known.
            braking: m/s^2.
            limits: a known speed limit replaces `desired`.
            lights: the caps halt before a light that binds (negative beyond it).
        """
        count = int(CAPPED_AHEAD / SPACING)
        grid = SPACING * torch.arange(count, device=self.s.device, dtype=self.s.dtype)
        place = self.s[:, None] + grid
        curvature = interpolate(self.mission.points, place)[2]
        bend = (
            avg_pool1d(
                curvature,
                3,
                stride=1,
                padding=1,
            )
            .abs()
            .clamp(min=1e-4)
        )
        speed = torch.sqrt(LATERAL_ACCELERATION / bend).clamp(max=1e3)
        limit = self.desired_speed(
            desired,
            place,
            limits=limits,
        )
        squared = torch.minimum(speed, limit) ** 2
        potential = (squared + 2 * braking * grid).flip(-1).cummin(-1).values.flip(-1)
        if lights:
            halt = self.stop_distance(braking)[:, None]
            potential = torch.minimum(potential, 2 * braking * halt)
        return potential - 2 * braking * grid

    def desired_speed(
        self,
        desired: float,
        place: Tensor,
        limits: bool = True,
    ) -> Tensor:
        """Speed limits [B, ...] m/s at places [B, ...] m; `desired` m/s where none is
        known."""
        limit = limit_at(self.mission, place) if limits else torch.zeros_like(place)
        return torch.where(limit > 0, limit, desired)

    def stop_distance(self, braking: float = BRAKING) -> Tensor:
        """Metres [B] until the ego's front is STOP_GAP m before the next stop line that
        binds; negative beyond that point, inf for none. A yellow light binds if
        `braking` m/s^2 halts before it, a red one if twice as much does.
        """
        scene = self.world.scene
        lights = light_state_at(
            scene["light_state"],
            self.mission.light,
            step=self.world.step,
        )
        line = stop_line_distance(
            lights,
            self.mission.light_s - self.s[:, None],
            speed=self.world.states[:, 0, 3],
            red_braking=2 * braking,
            yellow_braking=braking,
        )
        return line - scene["size"][:, 0, 0] / 2 - STOP_GAP


def look_up(caps: Tensor, ahead: Tensor) -> Tensor:
    """Speeds [B, ...] of the squared caps of `speed_caps` at `ahead` [B, ...] metres;
    the last cap is held."""
    low, high, fraction = between_entries(caps, ahead / SPACING)
    return (low + fraction * (high - low)).clamp(min=0).sqrt()


def between_entries(table: Tensor, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The entries of a table [B, K] before and after places [B, ...], in entries, and
    the fraction of the distance between them; outside of the table, its first and
    last."""
    place = place.clamp(0, table.shape[-1] - 1.001)
    index = place.long()
    flat = index.flatten(1)
    low = table.gather(1, flat).view(place.shape)
    high = table.gather(1, flat + 1).view(place.shape)
    return low, high, place - index
