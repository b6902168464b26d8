"""Routes as curves: shapely measures the same lengths, offsets and points."""

import pytest
import torch
from shapely.geometry import LineString, Point

from e2rl.scenes.paths import wrap
from e2rl.scenes.route import (
    SPACING,
    interpolate,
    project,
    project_track,
)
from tests.loops import (
    CROSSING,
    loop,
    track,
)


def wavy(seed: int, count: int = 60) -> torch.Tensor:
    """A route [P, 2] of chords SPACING long whose heading wanders slowly."""
    generator = torch.Generator().manual_seed(seed)
    heading = (
        0.12
        * torch.randn(
            count,
            generator=generator,
            dtype=torch.float64,
        )
    ).cumsum(0)
    step = SPACING * torch.stack([heading.cos(), heading.sin()], -1)
    return torch.cat([torch.zeros(1, 2, dtype=torch.float64), step.cumsum(0)])


@pytest.mark.parametrize("seed", range(4))
def test_projection_is_shapelys(seed):
    route = wavy(seed)
    generator = torch.Generator().manual_seed(seed + 9)
    s = (
        torch.rand(
            50,
            generator=generator,
            dtype=torch.float64,
        )
        * (SPACING * (len(route) - 2))
        + 1
    )
    base, heading, _ = interpolate(route, s)
    aside = (
        6
        * torch.rand(
            50,
            generator=generator,
            dtype=torch.float64,
        )
        - 3
    )
    points = base + aside[:, None] * torch.stack([-heading.sin(), heading.cos()], -1)
    line = LineString(route.tolist())
    along, offset, _ = project(points, route)
    oracle = [Point(point.tolist()) for point in points]
    distance = torch.tensor(
        [line.distance(point) for point in oracle], dtype=torch.float64
    )
    assert offset.abs().allclose(distance, atol=1e-6)
    assert along.allclose(
        torch.tensor([line.project(point) for point in oracle], dtype=torch.float64),
        atol=1e-6,
    )
    clear = aside.abs() > 0.1
    assert (offset.sign() == aside.sign())[clear].all()


def test_interpolation_lies_on_the_line_and_projects_back():
    route = wavy(3)
    s = torch.linspace(
        0,
        SPACING * (len(route) - 1),
        301,
        dtype=torch.float64,
    )
    points, heading, _ = interpolate(route, s)
    line = LineString(route.tolist())
    apart = [
        line.interpolate(a).distance(Point(p))
        for a, p in zip(s.tolist(), points.tolist(), strict=True)
    ]
    assert max(apart) < 1e-9
    back, offset, chord = project(points, route, hint=s)
    assert back.allclose(s, atol=1e-6)
    assert offset.abs().max() < 1e-6
    assert (
        heading - chord
    ).abs().max() < 0.4  # chords and vertex tangents differ by the bend


def test_beyond_the_ends_the_route_goes_on_straight():
    route = torch.tensor([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]])
    points, heading, curvature = interpolate(route, torch.tensor([-3.0, 7.0]))
    assert points.tolist() == [[-3.0, 0.0], [7.0, 0.0]]
    assert not heading.any()
    assert not curvature.any()
    s, d, _ = project(torch.tensor([[-3.0, 1.0], [7.0, -2.0]]), route)
    assert s.tolist() == [-3.0, 7.0]
    assert d.tolist() == [1.0, -2.0]


def test_curvature_of_a_circle_is_its_inverse_radius():
    radius = 30.0
    angle = torch.arange(40) * SPACING / radius
    route = radius * torch.stack([angle.sin(), 1 - angle.cos()], -1)
    _, heading, curvature = interpolate(route, torch.linspace(4, 70, 50))
    assert (curvature - 1 / radius).abs().max() < 1e-3
    assert (heading - torch.linspace(4, 70, 50) / radius).abs().max() < 1e-3


def test_leading_dims_broadcast_and_a_hint_chooses_the_pass():
    routes = torch.stack([wavy(1), wavy(2)]).float()[:, None]
    points = torch.randn(
        2,
        5,
        7,
        2,
    )
    s, d, heading = project(points, routes)
    assert s.shape == d.shape == heading.shape == (2, 5, 7)
    single = project(points[1, 3], routes[1, 0])
    assert s[1, 3].allclose(single[0], atol=1e-4)
    assert d[1, 3].allclose(single[1], atol=1e-4)
    angle = torch.arange(120) * SPACING / 20.0  # nearly two rounds of a circle
    loop = 20.0 * torch.stack([angle.cos(), angle.sin()], -1)
    here = loop[10:11]
    assert abs(project(here, loop, hint=torch.tensor([20.0]))[0].item() - 20.0) < 0.1
    assert (
        abs(
            project(here, loop, hint=torch.tensor([145.0]))[0].item()
            - 20.0
            - 40 * torch.pi
        )
        < 0.1
    )


def test_interpolation_differentiates():
    route = wavy(5)
    s = torch.tensor(
        [11.3, 47.9],
        dtype=torch.float64,
        requires_grad=True,
    )
    points, _, _ = interpolate(route, s)
    (slope,) = torch.autograd.grad(points[:, 0].sum() + points[:, 1].sum(), s)
    small = 1e-4
    forward, _, _ = interpolate(route, s.detach() + small)
    assert slope.allclose((forward - points.detach()).sum(-1) / small, atol=1e-6)


@pytest.mark.parametrize("begin", [20.0, CROSSING[0] - 3])
def test_a_track_is_followed_across_the_crossing_of_a_loop(begin):
    """The nearest place alone jumps by the length of the loop, in both directions."""
    states = track(loop(), begin, speed=25.0)
    for points in (states[:, :2], states[:, :2] + torch.tensor([0.3, -0.4])):
        s, d, heading = (
            value[0] for value in project_track(points[None], loop()[None], start=begin)
        )
        assert (s - begin - 2.5 * torch.arange(81)).abs().max() < 0.6
        assert d.abs().max() < 0.6
        assert wrap(heading - states[:, 2]).abs().max() < 0.1


def test_a_gap_in_a_track_is_no_jump_and_what_does_not_jump_is_projected():
    states = track(loop(), 20.0, speed=25.0)
    certain = torch.ones(1, 81, dtype=torch.bool)
    certain[0, 30:40] = False
    points = torch.where(certain[0, :, None], states[:, :2], 0.0)[None]
    s = project_track(
        points,
        loop()[None],
        known=certain,
        start=20.0,
    )[0][0]
    assert (s - 20 - 2.5 * torch.arange(81))[certain[0]].abs().max() < 0.6
    short = states[None, :8, :2]
    assert torch.equal(
        project_track(short, loop()[None])[0], project(short, loop()[None])[0]
    )
