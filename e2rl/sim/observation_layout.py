"""What each number of the observation is: names, units, scales, for policies from elsewhere (docs/observation.md)."""

from typing import NamedTuple

from e2rl.sim.observation import FAR, LOOK_AHEAD, NEAR, NEAREST, OBSERVATION_SIZE, PROBE_X, PROBE_Y, SPEED, TURNING
from e2rl.sim.prospects import ACCELERATIONS, OFFSETS, TIMES, WIDEST


class Entry(NamedTuple):
    """A number of the observation: its name; number times scale is in unit ("" for shares, sines and flags)."""

    name: str
    unit: str = ""
    scale: float = 1.0


EGO = (
    Entry("speed", "m/s", SPEED),
    Entry("acceleration", "m/s^2", 4.0),
    Entry("yaw_rate", "rad/s"),
    Entry("offset", "m", 3.0),
    Entry("heading_sin"),
    Entry("heading_cos"),
    Entry("limit", "m/s", SPEED),
    Entry("left", "m", 100.0),
    Entry("length", "m", 5.0),
    Entry("width", "m", 2.0),
    Entry("elapsed"),
)
POINT = (
    Entry("x", "m", FAR),
    Entry("y", "m", NEAR),
    Entry("heading_sin"),
    Entry("curvature", "1/m", 0.1),
    Entry("limit", "m/s", SPEED),
)
LIGHT = (Entry("red"), Entry("yellow"), Entry("green"), Entry("nearness"))
AGENT = (
    Entry("present"),
    Entry("x", "m", FAR),
    Entry("y", "m", NEAR),
    Entry("heading_cos"),
    Entry("heading_sin"),
    Entry("velocity_x", "m/s", SPEED),
    Entry("velocity_y", "m/s", SPEED),
    Entry("speed", "m/s", SPEED),
    Entry("acceleration", "m/s^2", 4.0),
    Entry("half_length", "m", 2.5),
    Entry("half_width", "m", 1.0),
    Entry("vehicle"),
    Entry("gap", "m", NEAR),
    Entry("approach_time"),
    Entry("approach_distance"),
    Entry("turn_rate", "rad/s", TURNING),
)


def observation_layout() -> list[Entry]:
    """The OBSERVATION_SIZE entries of an observation, in order, named `block.number.quantity`."""
    manoeuvres = [f"{accel:+g}.{offset:+g}" for accel in ACCELERATIONS for offset in OFFSETS]
    blocks = [
        _named("ego", EGO),
        *(_named(f"route.{k}", POINT) for k in range(len(LOOK_AHEAD))),
        *(_named(f"light.{k}", LIGHT) for k in range(2)),
        [Entry(f"border.{x:+g}.{y:+g}", "m", 4.0) for x in PROBE_X for y in PROBE_Y],
        *(_named(f"agent.{k}", AGENT) for k in range(NEAREST)),
        [Entry(f"manoeuvre.{name}.gap", "m", WIDEST) for name in manoeuvres],
        [Entry(f"manoeuvre.{name}.contact", "s", TIMES[-1] + TIMES[0]) for name in manoeuvres],
    ]
    found = [entry for block in blocks for entry in block]
    assert len(found) == OBSERVATION_SIZE
    return found


def _named(block: str, entries: tuple[Entry, ...]) -> list[Entry]:
    return [entry._replace(name=f"{block}.{entry.name}") for entry in entries]
