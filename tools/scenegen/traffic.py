"""Who drives: vehicle types with literature values, and departures."""

from pathlib import Path

import numpy as np

from scenegen.layout import Layout

TYPES = 40
# body: share, length range, width range [m], SUMO class
BODIES = [
    (0.62, (4.0, 5.0), (1.72, 1.92), "passenger"),
    (0.28, (4.6, 5.7), (1.86, 2.05), "passenger"),
    (0.06, (5.4, 6.6), (1.95, 2.1), "delivery"),
    (0.04, (8.0, 12.0), (2.4, 2.5), "truck"),
]
MODELS = [(0.35, "IDM"), (0.45, "EIDM"), (0.20, "Krauss")]


def vehicle_type(rng: np.random.Generator, name: str) -> str:
    """One random vType: IDM, EIDM or Krauss drivers, calm to brisk, who do not all keep
    to the lane's centre."""
    _, length, width, kind = BODIES[
        rng.choice(len(BODIES), p=[body[0] for body in BODIES])
    ]
    model = MODELS[rng.choice(len(MODELS), p=[row[0] for row in MODELS])][1]
    truck = kind == "truck"
    values = {
        "vClass": kind,
        "length": rng.uniform(*length),
        "width": rng.uniform(*width),
        "carFollowModel": model,
        "accel": rng.uniform(1.0, 1.5) if truck else rng.uniform(1.4, 2.6),
        "decel": rng.uniform(1.3, 2.6) + (1.2 if model == "Krauss" else 0.0),
        "emergencyDecel": 8.0,
        "tau": np.clip(rng.lognormal(np.log(1.3), 0.35), 0.8, 2.5),
        "minGap": rng.uniform(1.8, 4.5),
        "speedFactor": "normc(1,0.12,0.7,1.25)",
        "maxSpeed": 25.0 if truck else 45.0,
        "maxSpeedLat": rng.uniform(0.9, 1.5),
        "lcAccelLat": rng.uniform(0.6, 1.2),
        "lcPushy": 0,
        "latAlignment": np.clip(rng.normal(0, 0.22), -0.5, 0.5),
        "minGapLat": rng.uniform(0.4, 0.8),
        "startupDelay": rng.uniform(0.0, 0.8),
        "jmTimegapMinor": rng.uniform(0.8, 1.6),
        "impatience": rng.uniform(0, 0.3),
    }
    if model == "Krauss":
        values["sigma"] = rng.uniform(0.1, 0.5)
    text = " ".join(
        f'{k}="{v if isinstance(v, str) else f"{v:.3f}"}"' for k, v in values.items()
    )
    return f'  <vType id="{name}" {text}/>'


def write_demand(
    layout: Layout, folder: Path, seconds: float, rng: np.random.Generator
) -> Path:
    """Write Poisson departures of random types on the layout's origin-destination
    pairs; returns the file."""
    types = [f"t{k}" for k in range(TYPES)]
    rows = []
    for start, end, per_hour in layout.demand:
        for depart in rng.uniform(0, seconds, rng.poisson(per_hour * seconds / 3600)):
            rows.append((depart, start, end, types[rng.integers(TYPES)]))
    rows.sort()
    lines = ["<routes>", *[vehicle_type(rng, name) for name in types]]
    lines += [
        f'  <trip id="v{k}" type="{kind}" depart="{depart:.1f}" from="{start}" '
        f'to="{end}" departLane="best" '
        'departSpeed="max"/>'
        for k, (depart, start, end, kind) in enumerate(rows)
    ]
    path = folder / f"{layout.name}.rou.xml"
    path.write_text("\n".join([*lines, "</routes>"]))
    return path
