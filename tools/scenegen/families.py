"""Families of road layouts with random parameters: each function draws one Layout."""

from collections.abc import Callable

import numpy as np

from scenegen.layout import Arm, Layout, cut, road_axis
from scenegen.networks import arterial, grid, lane_drop, ramp, roundabout

SIGNAL = "traffic_light"
PRIORITY = "priority"
STOP = "allway_stop"
MEDIUM = 13.9  # m/s


def bends(rng: np.random.Generator, radius: float) -> np.ndarray:
    """Curvatures of a road that leaves a junction straight and then bends gently, at
    least `radius` m wide."""
    return np.array([0.0, 0.0, *(rng.uniform(-1, 1, 3) / radius)])


def star(
    rng,
    name: str,
    kind: str,
    angles,
    roads: list[tuple[int, float, int]],
    flow,
    pocket=False,
) -> Layout:
    """A junction of arms; roads: lanes, speed, rank of each; flow: vehicles per hour
    and inward lane, of each."""
    layout = Layout(name, rng.uniform(3.2, 3.7))
    centre = layout.node(np.zeros(2), kind, rng.uniform(5, 9))
    median = layout.lane_width if pocket else rng.choice([0.0, 0.3])
    arms = []
    for angle, (count, speed, rank) in zip(angles, roads, strict=True):
        axis = road_axis(
            np.zeros(2),
            angle,
            90.0 + 8.5 * speed,
            bends(rng, max(2.0 * speed**2, 90.0)),
        )
        depth = rng.uniform(45, 70) if pocket and count > 1 else 0.0
        arms.append(layout.arm(centre, axis, count, speed, rank, median, depth))
    layout.join(arms)
    spread_demand(layout, arms, flow, rng)
    if max(speed for _, speed, _ in roads) < 14.5:
        layout.parking += [
            edge for arm in arms if not arm.pocket for edge in (arm.inward, arm.outward)
        ]
    return layout


def spread_demand(layout: Layout, arms: list[Arm], flow, rng) -> None:
    """Vehicles per hour from every arm to every other: straight on most often."""
    for a, per_lane in zip(arms, flow, strict=True):
        targets = [b for b in arms if b is not a]
        turn = np.array(
            [abs(np.cos((b.angle - a.angle) / 2)) for b in targets]
        )  # 0 straight on, 0.7 a right angle
        share = rng.dirichlet(np.where(turn < 0.4, 6.0, 2.5))
        for b, part in zip(targets, share, strict=True):
            layout.demand.append(
                (a.border, b.outward, float(per_lane * a.lanes * part))
            )


def cross_angles(rng, arms: int = 4, jitter: float = 0.2) -> np.ndarray:
    """Arm directions near right angles, turned as a whole by chance."""
    return (
        rng.uniform(0, 2 * np.pi)
        + np.arange(arms) * np.pi / 2
        + rng.uniform(-jitter, jitter, arms)
    )


def signalled_cross(rng, name: str) -> Layout:
    """Four-way signals with left-turn pockets."""
    roads = [(int(rng.integers(2, 4)), rng.uniform(13, 17.5), 3), (2, MEDIUM, 2)] * 2
    angles = cross_angles(rng, 4, 0.12)
    flow = np.array([420, 330] * 2)
    return star(
        rng, name, SIGNAL, angles, roads, rng.uniform(0.3, 0.8) * flow, pocket=True
    )


def signalled_small(rng, name: str) -> Layout:
    """Four-way signals of single-lane streets."""
    return star(
        rng,
        name,
        SIGNAL,
        cross_angles(rng),
        [(1, MEDIUM, 2)] * 4,
        rng.uniform(0.3, 0.8, 4) * 480,
    )


def priority_cross(rng, name: str) -> Layout:
    """A main road that side roads cross, by priority or by stop signs."""
    lanes = int(rng.integers(1, 3))
    kind = rng.choice([PRIORITY, "priority_stop"])
    roads = [(lanes, rng.uniform(11, 16.5), 4), (1, 11.1, 1)] * 2
    flow = np.array([560, 260] * 2)
    return star(rng, name, kind, cross_angles(rng), roads, rng.uniform(0.4, 0.8) * flow)


def t_junction(rng, name: str) -> Layout:
    """A side road that ends at a main road."""
    angles = rng.uniform(0, 2 * np.pi) + np.array(
        [0, np.pi, np.pi / 2 + rng.uniform(-0.35, 0.35)]
    )
    main = (int(rng.integers(1, 3)), MEDIUM, 4)
    flow = np.array([600, 600, 380])
    return star(
        rng,
        name,
        PRIORITY,
        angles,
        [main, main, (1, 11.1, 1)],
        rng.uniform(0.4, 0.8) * flow,
    )


def allway_stop(rng, name: str) -> Layout:
    """All-way stop of residential streets."""
    return star(
        rng,
        name,
        STOP,
        cross_angles(rng),
        [(1, 11.1, 2)] * 4,
        rng.uniform(0.4, 0.8, 4) * 330,
    )


def curved_road(rng, name: str) -> Layout:
    """A winding road with a side road or two."""
    layout = Layout(name, rng.uniform(3.3, 3.7))
    speed = rng.uniform(11, 16)
    lanes = int(rng.integers(1, 3))
    signs = np.resize([1, -1], 6) * rng.choice([-1, 1])
    axis = road_axis(
        np.zeros(2),
        rng.uniform(0, 2 * np.pi),
        420.0,
        np.array([0, *(signs * rng.uniform(0.4, 1.0, 6) * 1.3 / speed**2), 0]),
    )
    at = 210.0 + rng.uniform(-40, 40)
    main = [cut(axis, 0, at)[::-1], cut(axis, at, 0)]
    centre = layout.node(main[1][0], PRIORITY, rng.uniform(5, 8))
    arms = [layout.arm(centre, part, lanes, speed, 4) for part in main]
    side = arms[1].angle + rng.choice([-1, 1]) * (np.pi / 2 + rng.uniform(-0.2, 0.2))
    arms.append(
        layout.arm(centre, road_axis(main[1][0], side, 150, bends(rng, 80)), 1, 11.1, 1)
    )
    layout.join(arms)
    spread_demand(layout, arms, rng.uniform(0.4, 0.8) * np.array([650, 650, 300]), rng)
    return layout


# Families with the number of their nets in a round of 30; nets of a family fall into
# all splits.
FAMILIES: list[tuple[Callable[[np.random.Generator, str], Layout], int]] = [
    (signalled_cross, 6),
    (signalled_small, 2),
    (priority_cross, 4),
    (t_junction, 3),
    (allway_stop, 3),
    (roundabout, 3),
    (ramp, 2),
    (arterial, 3),
    (curved_road, 2),
    (grid, 1),
    (lane_drop, 1),
]


def schedule(count: int) -> list[Callable[[np.random.Generator, str], Layout]]:
    """Families of `count` nets, spread evenly in the proportions of FAMILIES."""
    position = [
        ((k + 0.5) / share, index)
        for index, (_, share) in enumerate(FAMILIES)
        for k in range(share)
    ]
    order = [FAMILIES[index][0] for _, index in sorted(position)]
    return [order[k % len(order)] for k in range(count)]
