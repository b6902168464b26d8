"""A scene in words, seen from the ego: what a language-model reasoner is asked about (Sec. IV-A2)."""

import math

from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.boxes import to_frame
from e2rl.scene.recording import LIGHT_UNKNOWN
from e2rl.scene.route import SPACING, interpolate, project
from e2rl.sim.mission import mission_of
from e2rl.sim.world import World
from e2rl.synthesizer.feasibility import Feasibility, FeasibilitySettings, feasible_vehicles
from e2rl.synthesizer.motion import place

LIGHTS = {1: "red", 2: "yellow", 3: "green"}


def _bearing(local: Tensor) -> str:
    x, y = local.tolist()
    ahead = f"{abs(x):.0f} m {'ahead of' if x >= 0 else 'behind'} it"
    return ahead if abs(y) < 1 else f"{ahead} and {abs(y):.0f} m to its {'left' if y > 0 else 'right'}"


def _course(turn: float) -> str:
    turn = math.degrees(math.remainder(turn, 2 * math.pi))
    if abs(turn) < 25:
        return "in the ego's direction"
    if abs(turn) > 155:
        return "against the ego's direction"
    return f"turned {abs(turn):.0f} degrees to the {'left' if turn > 0 else 'right'} of the ego"


def _way(route: Tensor, s: Tensor) -> str:
    """Where a route [P, 2] leads within 50 m of arc length s []."""
    _, heading, _ = interpolate(route, s + SPACING * s.new_tensor(range(26)))
    turn = sum(math.remainder(b - a, 2 * math.pi) for a, b in zip(heading.tolist(), heading.tolist()[1:], strict=False))
    if abs(turn) < 0.4:
        return "goes straight on"
    return f"turns {'left' if turn > 0 else 'right'} by {math.degrees(abs(turn)):.0f} degrees"


def _lights(scene: TensorDictBase, step: int, vehicle: int, candidate: int, s: float) -> str:
    index = int(scene["route_light"][vehicle, candidate, 0])
    ahead = float(scene["route_light_s"][vehicle, candidate, 0]) - s
    if index < 0 or ahead < 0:
        return ""
    state = int(scene["light_state"][min(step, scene["light_state"].shape[0] - 1), index])
    return "" if state == LIGHT_UNKNOWN else f", {LIGHTS[state]} light in {ahead:.0f} m"


def present_vehicles(scene: TensorDictBase, world: World, row: int) -> list[int]:
    """The vehicles of a scene that may be asked about: there now, not parked, not the ego."""
    vehicles = scene["route_points"].shape[1]
    here = world.valid[row, :vehicles] & ~scene["parked"][row, :vehicles]
    return [vehicle for vehicle in here.nonzero()[:, 0].tolist() if vehicle > 0]


def describe_ego(scene: TensorDictBase, world: World, row: int) -> str:
    """How the ego of scene `row` drives, and where its mission leads."""
    mission = mission_of(scene[row : row + 1])
    limit, s = float(mission.limit[0, 10]), project(world.states[row : row + 1, :1, :2], mission.points)[0][0, 0]
    return (
        f"The ego drives at {world.states[row, 0, 3]:.1f} m/s"
        + (f" (limit {limit:.0f} m/s)" if limit else "")
        + f"; its way {_way(mission.points[0], s)}."
    )


def describe_vehicle(scene: TensorDictBase, world: World, judged: Feasibility, row: int, vehicle: int) -> str:
    """A few sentences about `vehicle` of scene `row`: place, motion, lane, and how its routes meet the ego's way (the
    conflict table of the rules, without their verdict)."""
    state, ego, size = world.states[row, vehicle], world.states[row, 0], scene["size"][row, vehicle].tolist()
    here = slice(vehicle, vehicle + 1)
    s, d, turned = (
        x[0, 0] for x in place(world.states[row : row + 1, here], scene["route_points"][row : row + 1, here])
    )
    lines = [
        f"Vehicle {vehicle} ({size[0]:.1f} x {size[1]:.1f} m) is {_bearing(to_frame(state[:2], ego))}, "
        f"{_course(float(state[2] - ego[2]))}, at {state[3]:.1f} m/s"
        + (", parked." if scene["parked"][row, vehicle] else ".")
    ]
    table = judged.conflicts
    for candidate in scene["route_valid"][row, vehicle].nonzero()[:, 0].tolist():
        at = (row, vehicle, candidate)
        text = f"Route {candidate}: {abs(d[candidate]):.1f} m beside its centreline, "
        text += f"turned {math.degrees(abs(turned[candidate])):.0f} degrees to it; it "
        text += _way(scene["route_points"][at], s[candidate])
        text += _lights(scene[row], int(world.step[row]), vehicle, candidate, float(s[candidate]))
        if table.has[at]:
            text += (
                f"; meets the ego's way in {table.own_s[at] - s[candidate]:.0f} m, both can be there "
                f"{table.earliest[at]:.1f} to {table.latest[at]:.1f} s from now, {table.offset[at]:.1f} s apart "
                "at present speeds"
            )
        else:
            text += "; does not meet the ego's way in time"
        lines.append(text + ".")
    return " ".join(lines if len(lines) > 1 else [*lines, "It follows no lane."])


def describe(
    scene: TensorDictBase, world: World, vehicle: int, row: int = 0, settings: FeasibilitySettings | None = None
) -> str:
    """The ego and `vehicle` of scene `row` of the batch [B] in words, with the verdict of the rules: for people."""
    judged = feasible_vehicles(scene, world, settings or FeasibilitySettings())
    verdict = {
        "on a lane": judged.associated,
        "can meet the ego": judged.conflicting,
        "moving or in the way": judged.relevant,
    }
    rules = ", ".join(f"{name}: {'yes' if mask[row, vehicle] else 'no'}" for name, mask in verdict.items())
    return " ".join(
        [
            describe_ego(scene, world, row),
            describe_vehicle(scene, world, judged, row, vehicle),
            f"Rules: {rules}. Feasible: {'yes' if judged.mask[row, vehicle] else 'no'}.",
        ]
    )
