"""Small priors with random weights, and scenes with curved, crossing routes, for the
tests of what stands on them."""

import math

import torch
from tensordict import TensorDict

from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.lane_relative import LaneState, locate
from e2rl.prior.prior import Prior
from e2rl.scenes.route import SPACING, interpolate
from tests.synthetic import make_scenes


def small_prior(seed: int = 0, **options) -> Prior:
    """A prior whose zero-initialised layers are random too, so that everything in it
    matters."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        prior = Prior(
            DenoiserSettings(
                width=32,
                blocks=1,
            ),
            **options,
        )
        with torch.no_grad():
            for block in prior.denoiser.blocks:
                block.modulation.weight.normal_(0, 0.1)
                block.modulation.bias.normal_(0, 0.5)
            prior.denoiser.head[1].weight.normal_(0, 0.1)
    return prior.requires_grad_(False).eval()


def arc(
    x: float,
    y: float,
    heading: float,
    curvature: float,
    count: int = 150,
    back: float = 20.0,
) -> torch.Tensor:
    """Vertices [count, 2] of a route of constant curvature that passes (x, y) with
    `heading` after `back` metres."""
    s = SPACING * torch.arange(count, dtype=torch.float64) - back
    turn = heading + curvature * s
    if curvature:
        along = (
            torch.stack(
                [turn.sin() - math.sin(heading), math.cos(heading) - turn.cos()], -1
            )
            / curvature
        )
    else:
        along = s[:, None] * torch.tensor(
            [math.cos(heading), math.sin(heading)], dtype=torch.float64
        )
    return (torch.tensor([x, y], dtype=torch.float64) + along).float()


VEHICLES = [  # x, y, heading, speed, curvature and side offset of the route
    (0.0, 0.0, 0.0, 8.0, 0.0, 0.3),
    (18.0, 0.4, 0.05, 6.0, 0.01, -0.2),
    (30.0, -25.0, 1.5, 7.0, -0.012, 0.5),
    (-15.0, 6.0, -0.2, 9.0, 0.004, 0.0),
    (45.0, 30.0, -1.7, 0.2, 0.008, -0.4),
    (5.0, 3.5, 0.1, 8.0, 0.0, 0.0),
]


def curved_scenes(copies: int = 1, rows: int = 8, **options) -> TensorDict:
    """Scenes [copies] of VEHICLES, each beside its own curved route, one behind
    another, some crossing; red lights."""
    count = len(VEHICLES)
    scene = make_scenes(
        copies,
        num_vehicles=count,
        num_vrus=1,
        max_vehicles=rows,
        max_agents=rows + 2,
        red_light_x=30.0,
        **options,
    ).scenes
    time = 0.1 * torch.arange(scene["logged"].shape[1])
    for i, (x, y, heading, speed, curvature, aside) in enumerate(VEHICLES):
        scene["start"][:, i] = torch.tensor([x, y, heading, speed])
        scene["start_accel"][:, i], scene["start_yaw_rate"][:, i] = (
            0.3 - 0.1 * i,
            curvature * speed + 0.02,
        )
        side = (x + aside * math.sin(heading), y - aside * math.cos(heading))
        scene["route_points"][:, i] = arc(*side, heading - 0.1 * aside, curvature)
        turn = heading + curvature * speed * time
        track = torch.stack([turn.cos(), turn.sin()], -1) * speed * 0.1
        xy = torch.tensor([x, y]) + track.cumsum(0) - track[:1]
        scene["logged"][:, :, i] = torch.cat(
            [xy, turn[:, None], torch.full_like(turn, speed)[:, None]], -1
        )
        back = 0.1 * torch.arange(1, 11)
        scene["past"][:, i] = torch.stack(
            [0.2 * back**2 - speed * back, 0.3 * back, -0.1 * back], -1
        )
    scene["route_length"][:] = 250.0
    scene["route_open"][:, :count, 0] = True
    return scene


def mirrored(scene: TensorDict) -> TensorDict:
    """The scene reflected in the x axis."""
    scene = scene.clone()
    for key in ("start", "logged"):
        scene[key] = scene[key] * torch.tensor([1.0, -1.0, -1.0, 1.0])
    for key in ("route_points", "light_points", "lane_points", "drivable_points"):
        scene[key] = scene[key] * torch.tensor([1.0, -1.0])
    scene["start_yaw_rate"] = -scene["start_yaw_rate"]
    scene["past"] = scene["past"] * torch.tensor([1.0, -1.0, -1.0])
    return scene


def moved(
    scene: TensorDict,
    x: float,
    y: float,
    angle: float,
) -> TensorDict:
    """The scene turned by `angle` about the origin and then shifted by (x, y)."""
    scene = scene.clone()
    cos = math.cos(angle)
    sin = math.sin(angle)
    rotation = torch.tensor([[cos, sin], [-sin, cos]])
    shift = torch.tensor([x, y])
    for key in ("start", "logged"):
        xy = scene[key][..., :2] @ rotation + shift
        scene[key] = torch.cat(
            [xy, scene[key][..., 2:3] + angle, scene[key][..., 3:]], -1
        )
    for key in ("route_points", "light_points", "lane_points", "drivable_points"):
        scene[key] = scene[key] @ rotation + shift
    return scene


def random_state(
    points: torch.Tensor, generator: torch.Generator, speed=(2.0, 15.0)
) -> LaneState:
    """LaneState [V] of vehicles somewhere beside routes points [V, P, 2], within 2 m
    and 0.3 rad of them."""

    def draw(low, high):
        return low + (high - low) * torch.rand(len(points), generator=generator)  # noqa: E731

    s = draw(20, 40)
    d = draw(-2, 2)
    turn = draw(-0.3, 0.3)
    xy, heading, _ = (value[:, 0] for value in interpolate(points, s[:, None]))
    xy = xy + d[:, None] * torch.stack([-heading.sin(), heading.cos()], -1)
    v = draw(*speed)
    states = torch.cat([xy, (heading + turn)[:, None], v[:, None]], -1)
    state = locate(
        states[None],
        draw(-1, 1)[None],
        yaw_rate=v[None] * draw(-0.02, 0.02)[None],
        points=points[None],
    )
    return state.map(lambda value: value[0])
