"""What a scene holds, in numbers for a report on its data."""

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from e2rl.scenes.paths import arc_length
from e2rl.scenes.recording import AGENT_TYPES, VEHICLE

MOVES = 0.5  # m/s
Scene = Mapping[str, np.ndarray]


class Content(NamedTuple):
    """What a scene holds: `counts`, by what a line of the report says, and vertices of
    its routes by their speed `limits` [km/h]."""

    counts: dict[str, float]
    limits: Counter[int]


def content(scene: Scene) -> Content:
    """The content of one scene; agents are those present at its start frame."""
    present = scene["valid"]
    vehicles = scene["agent_type"] == VEHICLE
    path = np.diff(scene["logged"][scene["logged_valid"][:, 0], 0, :2], axis=0)
    moving = present & vehicles & (abs(scene["start"][:, 3]) > MOVES)
    later = scene["logged_valid"].any(0) & ~present & vehicles
    lengths = [
        arc_length(scene["lane_points"][scene["lane_index"] == lane])[-1]
        for lane in range(len(scene["lane_width"]))
    ]
    beside = (scene["lane_left"] >= 0) | (scene["lane_right"] >= 0)
    limits = scene["route_limit"][scene["route_valid"]]
    counts = {
        f"{name}s": (present & (scene["agent_type"] == kind)).sum()
        for kind, name in enumerate(AGENT_TYPES)
    }
    counts |= {
        "vehicles that move, beside the ego": moving[1:].sum(),
        "vehicles that appear later, near": later.sum(),
        "vehicles near that none drives": scene["left_out"],
        "median length of vehicles, m": np.median(scene["size"][present & vehicles, 0]),
        "speed of the ego at the start, m/s": scene["start"][0, 3],
        "distance driven by the ego, m": np.linalg.norm(path, axis=1).sum(),
        "lanes": len(lengths),
        "km of lanes": sum(lengths) / 1000,
        "% of lanes with a successor": 100 * (scene["lane_exits"] >= 0).any(1).mean(),
        "% of lanes with a neighbour": 100 * beside.mean(),
        "% of routes with a speed limit": 100 * (limits > 0).mean(),
        "drivable polygons": len(np.unique(scene["drivable_index"])),
        "traffic lights": len(scene["light_points"]),
    }
    speeds = np.sort(np.round(3.6 * limits).astype(int), axis=None)
    return Content(counts, Counter(speeds.tolist()))
