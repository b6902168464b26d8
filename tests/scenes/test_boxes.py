"""Boxes against shapely, and invariance under a common rigid motion."""

import pytest
import torch

from e2rl.scenes.boxes import (
    corners,
    distance,
    overlap,
    separation,
    signed_distance,
)

shapely = pytest.importorskip("shapely")


@pytest.fixture(scope="module")
def boxes():
    generator = torch.Generator().manual_seed(0)

    def draw():
        pose = torch.rand(
            10_000,
            3,
            generator=generator,
            dtype=torch.float64,
        ) * torch.tensor([12.0, 12.0, 6.3])
        return pose, 0.3 + torch.rand(
            10_000,
            2,
            generator=generator,
            dtype=torch.float64,
        ) * torch.tensor([8.0, 3.0])

    first = draw()
    second = draw()
    polygons = [
        shapely.polygons(corners(pose, size).numpy()) for pose, size in (first, second)
    ]
    return first, second, polygons


def between(
    function,
    first,
    second,
):
    """What a function of two boxes returns for (pose, size) each."""
    return function(
        first[0],
        first[1],
        second=second[0],
        second_size=second[1],
    )


def test_overlap_agrees_with_shapely(boxes):
    first, second, (a, b) = boxes
    area = torch.from_numpy(shapely.area(shapely.intersection(a, b)))
    overlaps = between(overlap, first, second)
    clear = (area == 0) | (area > 1e-9)
    assert 0.1 < overlaps.float().mean() < 0.9
    assert torch.equal(overlaps[clear], (area > 1e-9)[clear])


def test_distance_agrees_with_shapely(boxes):
    first, second, (a, b) = boxes
    expected = torch.from_numpy(shapely.distance(a, b))
    assert torch.allclose(between(distance, first, second), expected, atol=1e-9)


def test_penetration_is_the_shortest_way_apart(boxes):
    """Moving one box by the penetration depth along the best axis just ends the
    overlap."""
    first, second, _ = boxes
    depth = between(signed_distance, first, second)
    inside = depth < -1e-6
    moved = []
    for turn in (0.0, torch.pi / 2, torch.pi, -torch.pi / 2):
        for pose in (first[0], second[0]):
            way = torch.stack(
                [
                    (pose[:, 2] + turn).cos(),
                    (pose[:, 2] + turn).sin(),
                    torch.zeros(len(pose)),
                ],
                -1,
            )
            moved.append(
                separation(
                    first[0],
                    first[1],
                    second=second[0] - way * depth[:, None],
                    second_size=second[1],
                )
            )
    assert torch.allclose(
        torch.stack(moved).amax(0)[inside].clamp(max=0),
        torch.zeros(()).double(),
        atol=1e-6,
    )


def test_rigid_motion_and_order_do_not_matter(boxes):
    first, second, _ = boxes
    before = between(signed_distance, first, second)
    cos, sin = torch.tensor([0.8, 0.6], dtype=torch.float64)
    rotation = torch.stack([torch.stack([cos, -sin]), torch.stack([sin, cos])])

    def move(pose):
        turned = pose[:, :2] @ rotation.T + torch.tensor([3.0, -7.0])
        return torch.cat([turned, pose[:, 2:] + torch.atan2(sin, cos)], 1)

    assert torch.allclose(
        signed_distance(
            move(first[0]),
            first[1],
            second=move(second[0]),
            second_size=second[1],
        ),
        before,
    )
    assert torch.allclose(between(signed_distance, second, first), before)
