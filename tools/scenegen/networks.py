"""Layouts with several junctions: roundabouts, ramps, arterials, grids and lane drops."""

import numpy as np

from scenegen.layout import Arm, Layout, cut, road_axis

GAP = 34.0  # m over which a lane opens or closes


def ring_points(radius: float, begin: float, end: float) -> np.ndarray:
    """Counterclockwise arc around the origin, a point every 6 degrees."""
    angle = np.linspace(begin, end, max(int((end - begin) / 0.1), 4))
    return radius * np.stack([np.cos(angle), np.sin(angle)], -1)


def roundabout(rng, name: str) -> Layout:
    """A one-lane roundabout of three to five arms; the ring's speed bounds its lateral
    acceleration to 1.3 m/s^2."""
    layout = Layout(name, rng.uniform(3.5, 4.0))
    count = int(rng.integers(3, 6))
    radius = rng.uniform(13, 18) + 2.0 * (count - 3)
    angles = np.sort(
        rng.uniform(0, 2 * np.pi)
        + np.arange(count) * 2 * np.pi / count
        + rng.uniform(-0.15, 0.15, count)
    )
    speed = float(np.sqrt(1.3 * radius))
    centres = [radius * np.array([np.cos(a), np.sin(a)]) for a in angles]
    nodes = [layout.node(centre, "priority", 4.0) for centre in centres]
    ring = []
    for k in range(count):
        end = angles[(k + 1) % count] + (2 * np.pi if k + 1 == count else 0)
        ring.append(
            layout.edge(
                nodes[k],
                nodes[(k + 1) % count],
                ring_points(radius, angles[k], end),
                1,
                speed,
                9,
            )
        )
    arms = []
    for k, angle in enumerate(angles):
        axis = road_axis(
            centres[k], angle, 170.0, np.array([0, 0, *(rng.uniform(-1, 1, 3) / 120)])
        )
        arms.append(
            layout.arm(nodes[k], axis, 1, 11.1, 1, median=rng.uniform(1.0, 2.5))
        )
        before = ring[k - 1]
        layout.connect(before, ring[k], [(0, 0)])
        layout.connect(before, arms[k].outward, [(0, 0)])
        layout.connect(arms[k].inward, ring[k], [(0, 0)])
    for k, a in enumerate(arms):
        share = rng.dirichlet(np.full(count - 1, 3.0))
        targets = [arms[(k + 1 + j) % count] for j in range(count - 1)]
        flow = rng.uniform(0.4, 0.8) * 480
        layout.demand += [
            (a.border, b.outward, float(flow * part))
            for b, part in zip(targets, share, strict=True)
        ]
    return layout


def carriageway(
    layout: Layout, axis: np.ndarray, cuts: list[tuple[float, float, int]], speed: float
) -> list[str]:
    """One-way edges along `axis`: (begin, end, lanes) each; the gaps between them
    become tapers. Lanes join and leave on the right, so the left border is common."""
    nodes = [layout.node(axis[0], border=True)]
    for (_, end, _), (begin, _, _) in zip(cuts[:-1], cuts[1:], strict=True):
        nodes.append(layout.node(cut(axis, (begin + end) / 2, 0)[0]))
    nodes.append(layout.node(axis[-1], border=True))
    return [
        layout.edge(nodes[k], nodes[k + 1], cut(axis, begin, end), lanes, speed, 5)
        for k, (begin, end, lanes) in enumerate(cuts)
    ]


def ramp(rng, name: str) -> Layout:
    """A motorway with an on-ramp, and half of the time an off-ramp at the end of the
    auxiliary lane (a weave)."""
    layout = Layout(name, rng.uniform(3.5, 3.7))
    speed = rng.uniform(22, 28)
    lanes = int(rng.integers(2, 4))
    weave = bool(rng.random() < 0.5)
    axis = road_axis(
        np.zeros(2), rng.uniform(0, 2 * np.pi), 860.0, rng.uniform(-1, 1, 5) / 900
    )
    cuts = [
        (0.0, 300.0, lanes),
        (300.0 + GAP, 540.0, lanes + 1),
        (540.0 + 1.5 * GAP, 0.0, lanes),
    ]
    main = carriageway(layout, axis, cuts, speed)
    through = [(k, k + 1) for k in range(lanes)]
    layout.connect(main[0], main[1], through)
    layout.connect(main[1], main[2], [(b, a) for a, b in through])
    joint = [edge["to"] for edge in layout.edges[:2]]
    on = _ramp_axis(axis, 300.0, lanes * layout.lane_width, rng, ahead=False)
    start = layout.node(on[0], border=True)
    entry = layout.edge(start, joint[0], on, 1, 17.0, 2)
    layout.connect(entry, main[1], [(0, 0)])
    flow = rng.uniform(0.6, 0.9) * 1500 * lanes
    layout.demand += [(main[0], main[2], flow), (entry, main[2], rng.uniform(450, 800))]
    if weave:
        off = _ramp_axis(
            axis, 540.0 + 1.5 * GAP, lanes * layout.lane_width, rng, ahead=True
        )
        leave = layout.edge(
            joint[1], layout.node(off[-1], border=True), off, 1, 17.0, 2
        )
        layout.connect(main[1], leave, [(0, 0)])
        layout.demand += [(main[0], leave, 0.2 * flow), (entry, leave, 60.0)]
    else:
        layout.tapers.append((main[1], 0, main[2], 0))
    return layout


def _ramp_axis(
    axis: np.ndarray, at: float, right: float, rng, ahead: bool
) -> np.ndarray:
    """Left border of a ramp's lane that lies `right` m beside the axis at arc length
    `at` and bends away from it."""
    here = cut(axis, at, 0)
    heading = np.arctan2(*(here[1] - here[0])[::-1])
    foot = here[0] + right * np.array([np.sin(heading), -np.cos(heading)])
    turn = -rng.uniform(0.6, 1.0) / 180.0
    bend = np.array([0.0, turn, turn, 0.3 * turn])
    if ahead:
        return road_axis(foot, heading, 230.0, bend)
    return road_axis(foot, heading + np.pi, 230.0, -bend)[::-1]


def arterial(rng, name: str) -> Layout:
    """A main road with side streets and driveways on both sides, one of them signalled
    half of the time."""
    layout = Layout(name, rng.uniform(3.2, 3.6))
    speed = rng.uniform(12, 16)
    lanes = 2
    heading = rng.uniform(0, 2 * np.pi)
    median = rng.choice([0.0, 0.4])
    axis = road_axis(np.zeros(2), heading, 560.0, rng.uniform(-1, 1, 4) / 700)
    stops = np.cumsum(rng.uniform(65, 105, 4)) + 110.0
    signal = int(rng.integers(0, 8))
    bounds = [0.0, *stops, 560.0]
    nodes = [layout.node(axis[0], border=True)]
    nodes += [
        layout.node(
            cut(axis, s, 0)[0],
            "traffic_light" if k == signal else "priority",
            rng.uniform(4, 7),
        )
        for k, s in enumerate(stops)
    ]
    nodes.append(layout.node(axis[-1], border=True))
    arms: list[list[Arm]] = [[] for _ in nodes]
    for k in range(len(bounds) - 1):
        part = cut(axis, bounds[k], bounds[k + 1])
        forth = layout.arm(nodes[k], part, lanes, speed, 4, median, border=nodes[k + 1])
        back = Arm(
            part[::-1], lanes, speed, 4, forth.outward, forth.inward, forth.outward
        )
        arms[k].append(forth)
        arms[k + 1].append(back)
    for k in range(1, len(nodes) - 1):
        sides = [[-1], [1], [-1, 1]][int(rng.integers(0, 3))]
        for side in sides:
            here = cut(axis, bounds[k], 0)
            angle = np.arctan2(*(here[1] - here[0])[::-1]) + side * (
                np.pi / 2 + rng.uniform(-0.2, 0.2)
            )
            length = rng.choice([60.0, 130.0])
            road = road_axis(
                here[0], angle, length, np.array([0, 0, rng.uniform(-1, 1) / 60])
            )
            arms[k].append(
                layout.arm(nodes[k], road, 1, 8.3 if length < 100 else 11.1, 1)
            )
        layout.join(arms[k])
    _through_demand(layout, arms, rng, main=520.0 * lanes, side=110.0)
    return layout


def _through_demand(
    layout: Layout, arms: list[list[Arm]], rng, main: float, side: float
) -> None:
    """Traffic between all border arms: the axis' two ends carry `main` vehicles per
    hour, the others `side`."""
    ends = [arms[0][0], arms[-1][0]]
    doors = [
        (ends[0].outward, ends[0].inward, main),
        (ends[1].outward, ends[1].inward, main),
    ]
    doors += [
        (arm.border, arm.outward, side)
        for group in arms[1:-1]
        for arm in group
        if arm.rank == 1
    ]
    for k, (source, _, flow) in enumerate(doors):
        others = [j for j in range(len(doors)) if j != k]
        weight = np.array([doors[j][2] for j in others]) * rng.uniform(
            0.5, 1.5, len(others)
        )
        volume = rng.uniform(0.4, 0.8) * flow
        layout.demand += [
            (source, doors[j][1], float(volume * w / weight.sum()))
            for j, w in zip(others, weight, strict=True)
        ]


def grid(rng, name: str) -> Layout:
    """Two by two junctions, shifted by chance, with all-way stops, priorities and
    signals."""
    layout = Layout(name, rng.uniform(3.2, 3.6))
    pitch = rng.uniform(85, 120)
    place = {
        (i, j): np.array([i, j]) * pitch + rng.uniform(-14, 14, 2)
        for i in range(2)
        for j in range(2)
    }
    kinds = rng.choice(
        ["allway_stop", "priority", "traffic_light", "right_before_left"], 4
    )
    nodes = {
        key: layout.node(place[key], kind, rng.uniform(5, 7))
        for key, kind in zip(place, kinds, strict=True)
    }
    arms: dict[tuple[int, int], list[Arm]] = {key: [] for key in place}
    for a, b in (
        ((0, 0), (1, 0)),
        ((0, 1), (1, 1)),
        ((0, 0), (0, 1)),
        ((1, 0), (1, 1)),
    ):
        way = np.linspace(place[a], place[b], 20)
        rank = 3 if a[1] == b[1] else 1
        forth = layout.arm(nodes[a], way, 1, 12.0, rank, border=nodes[b])
        arms[a].append(forth)
        arms[b].append(
            Arm(way[::-1], 1, 12.0, rank, forth.outward, forth.inward, forth.outward)
        )
    doors = []
    for (i, j), point in place.items():
        for angle, rank in (
            ((0.0 if i else np.pi), 3),
            ((np.pi / 2 if j else -np.pi / 2), 1),
        ):
            road = road_axis(
                point,
                angle + rng.uniform(-0.2, 0.2),
                130.0,
                np.array([0, 0, rng.uniform(-1, 1) / 90]),
            )
            arms[i, j].append(layout.arm(nodes[i, j], road, 1, 12.0, rank))
            doors.append(arms[i, j][-1])
    for group in arms.values():
        layout.join(group)
    layout.parking += [edge["id"] for edge in layout.edges]
    for a in doors:
        flow = rng.uniform(0.4, 0.8) * 300
        layout.demand += [
            (a.border, b.outward, flow / (len(doors) - 1)) for b in doors if b is not a
        ]
    return layout


def lane_drop(rng, name: str) -> Layout:
    """A one-way road that loses its right lane."""
    layout = Layout(name, rng.uniform(3.3, 3.7))
    speed = rng.uniform(14, 19)
    lanes = int(rng.integers(2, 4))
    axis = road_axis(
        np.zeros(2), rng.uniform(0, 2 * np.pi), 560.0, rng.uniform(-1, 1, 5) / 350
    )
    road = carriageway(
        layout, axis, [(0.0, 300.0, lanes), (300.0 + 1.3 * GAP, 0.0, lanes - 1)], speed
    )
    layout.connect(road[0], road[1], [(k, k - 1) for k in range(1, lanes)])
    layout.tapers.append((road[0], 0, road[1], 0))
    layout.demand.append((road[0], road[1], rng.uniform(0.7, 1.0) * 1400 * (lanes - 1)))
    return layout
