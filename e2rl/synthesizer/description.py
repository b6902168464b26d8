"""A scene in words, seen from the ego: what a language-model reasoner is asked about (Sec. IV-A2)."""

import math

from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.boxes import to_frame
from e2rl.scene.recording import LIGHT_GREEN, LIGHT_RED, LIGHT_YELLOW
from e2rl.scene.route import SPACING, interpolate, project
from e2rl.sim.mission import mission_of
from e2rl.sim.traffic_light import light_state_at
from e2rl.sim.world import World
from e2rl.synthesizer.feasibility import Conflicts
from e2rl.synthesizer.motion import frenet_pose

LIGHTS = {LIGHT_RED: "red", LIGHT_YELLOW: "yellow", LIGHT_GREEN: "green"}


def _position(local: Tensor) -> str:
    x, y = local.tolist()
    ahead = f"{abs(x):.0f} m {'ahead of' if x >= 0 else 'behind'} it"
    return ahead if abs(y) < 1 else f"{ahead} and {abs(y):.0f} m to its {'left' if y > 0 else 'right'}"


def _heading(turn: float) -> str:
    turn = math.degrees(math.remainder(turn, 2 * math.pi))
    if abs(turn) < 25:
        return "in the ego's direction"
    if abs(turn) > 155:
        return "against the ego's direction"
    return f"turned {abs(turn):.0f} degrees to the {'left' if turn > 0 else 'right'} of the ego"


def _course(route: Tensor, s: Tensor) -> str:
    """Where a route [P, 2] leads within 50 m of arc length s []."""
    _, heading, _ = interpolate(route, s + SPACING * s.new_tensor(range(26)))
    turn = sum(math.remainder(b - a, 2 * math.pi) for a, b in zip(heading.tolist(), heading.tolist()[1:], strict=False))
    if abs(turn) < 0.4:
        return "goes straight on"
    return f"turns {'left' if turn > 0 else 'right'} by {math.degrees(abs(turn)):.0f} degrees"


def _next_light(scene: TensorDictBase, step: Tensor, vehicle: int, candidate: int, s: float) -> str:
    """The next light on a candidate route of scene [1] at step [1], where it is ahead of arc length s and known."""
    ahead = float(scene["route_light_s"][0, vehicle, candidate, 0]) - s
    light = scene["route_light"][:, vehicle, candidate, :1]
    colour = LIGHTS.get(int(light_state_at(scene["light_state"], light, step)))
    return f", {colour} light in {ahead:.0f} m" if colour and ahead >= 0 else ""


def describe(scene: TensorDictBase, world: World, conflicts: Conflicts, row: int) -> tuple[str, dict[int, str]]:
    """The ego of scene `row` in words, and every vehicle that is present and not parked, by its index."""
    vehicles = scene["route_points"].shape[1]
    present = (world.valid[row, :vehicles] & ~scene["parked"][row, :vehicles]).nonzero()[:, 0].tolist()
    texts = {vehicle: describe_vehicle(scene, world, conflicts, row, vehicle) for vehicle in present if vehicle > 0}
    return describe_ego(scene, world, row), texts


def describe_ego(scene: TensorDictBase, world: World, row: int) -> str:
    """How the ego of scene `row` drives, and where its mission leads."""
    mission = mission_of(scene[row : row + 1])
    limit, s = float(mission.limit[0, 10]), project(world.states[row : row + 1, :1, :2], mission.points)[0][0, 0]
    limited = f" (limit {limit:.0f} m/s)" if limit else ""
    return f"The ego drives at {world.states[row, 0, 3]:.1f} m/s{limited}; its route {_course(mission.points[0], s)}."


def describe_vehicle(scene: TensorDictBase, world: World, conflicts: Conflicts, row: int, vehicle: int) -> str:
    """A few sentences about `vehicle` of scene `row`: position, motion, and how its routes meet the ego's.

    The numbers are those of the rules' conflict points; their verdict is not told.
    """
    rows, here = slice(row, row + 1), slice(vehicle, vehicle + 1)
    state, ego, size = world.states[row, vehicle], world.states[row, 0], scene["size"][row, vehicle].tolist()
    sentences = [
        f"Vehicle {vehicle} ({size[0]:.1f} x {size[1]:.1f} m) is {_position(to_frame(state[:2], ego))}, "
        f"{_heading(float(state[2] - ego[2]))}, at {state[3]:.1f} m/s."
    ]
    s, d, error = (x[0, 0] for x in frenet_pose(world.states[rows, here], scene["route_points"][rows, here]))
    for candidate in scene["route_valid"][row, vehicle].nonzero()[:, 0].tolist():
        at = (row, vehicle, candidate)
        course = _course(scene["route_points"][at], s[candidate])
        light = _next_light(scene[rows], world.step[rows], vehicle, candidate, float(s[candidate]))
        meeting = "; does not meet the ego's route in time"
        if conflicts.exists[at]:
            meeting = (
                f"; meets the ego's route in {conflicts.s[at] - s[candidate]:.0f} m, both can be there "
                f"{conflicts.earliest[at]:.1f} to {conflicts.latest[at]:.1f} s from now, "
                f"{conflicts.time_gap[at]:.1f} s apart at present speeds"
            )
        sentences.append(
            f"Route {candidate}: {abs(d[candidate]):.1f} m beside its centreline, turned "
            f"{math.degrees(abs(error[candidate])):.0f} degrees to it; it {course}{light}{meeting}."
        )
    return " ".join(sentences if len(sentences) > 1 else [*sentences, "It follows no lane."])
