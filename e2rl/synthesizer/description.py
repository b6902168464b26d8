"""A scene in words, seen from the ego: what a language-model reasoner would be asked about one vehicle (Sec. IV-A2)."""

import math

from tensordict import TensorDictBase
from torch import Tensor

from e2rl.scene.recording import LIGHT_UNKNOWN
from e2rl.scene.route import SPACING, interpolate
from e2rl.sim.geometry import to_frame
from e2rl.sim.mission import mission_of
from e2rl.sim.world import World
from e2rl.synthesizer.feasibility import FeasibilitySettings, feasible_vehicles
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


def describe(scene: TensorDictBase, world: World, vehicle: int, row: int = 0,
             settings: FeasibilitySettings | None = None) -> str:
    """A few sentences about `vehicle` of scene `row` of the batch: place, motion, lane, and how its routes meet the
    ego's.

    scene and world are batched [B]; ends with the verdict of the rules, so that a reasoner can confirm or overrule it.
    """
    settings = settings or FeasibilitySettings()
    scene = scene[row:row + 1]
    world = World(scene, world.step[row:row + 1], world.states[row:row + 1], world.valid[row:row + 1],
                  world.accel[row:row + 1], world.route[row:row + 1])
    judged = feasible_vehicles(scene, world, settings)
    state, ego, size = world.states[0, vehicle], world.states[0, 0], scene["size"][0, vehicle].tolist()
    limit = float(mission_of(scene).limit[0, 10])
    here = slice(vehicle, vehicle + 1)
    s, d, _ = (x[0, 0] for x in place(world.states[:, here], scene["route_points"][:, here]))
    lines = [f"The ego drives at {ego[3]:.1f} m/s" + (f" (limit {limit:.0f} m/s)." if limit else "."),
             f"Vehicle {vehicle} ({size[0]:.1f} x {size[1]:.1f} m) is {_bearing(to_frame(state[:2], ego))}, "
             f"{_course(float(state[2] - ego[2]))}, at {state[3]:.1f} m/s"
             + (", parked." if scene["parked"][0, vehicle] else ".")]
    table = judged.conflicts
    for candidate in scene["route_valid"][0, vehicle].nonzero()[:, 0].tolist():
        at = (0, vehicle, candidate)
        text = f"Route {candidate}: {abs(d[candidate]):.1f} m beside it, "
        text += _way(scene["route_points"][at], s[candidate])
        text += _lights(scene[0], int(world.step[0]), vehicle, candidate, float(s[candidate]))
        if table.has[at]:
            text += (f"; meets the ego's way in {table.own_s[at] - s[candidate]:.0f} m, both can be there "
                     f"{table.earliest[at]:.1f} to {table.latest[at]:.1f} s from now, {table.offset[at]:.1f} s apart "
                     "at present speeds")
        lines.append(text + ".")
    verdict = {"on a lane": judged.associated, "can meet the ego": judged.conflicting,
               "moving or in the way": judged.relevant}
    lines.append("Rules: " + ", ".join(f"{name}: {'yes' if mask[0, vehicle] else 'no'}"
                                       for name, mask in verdict.items())
                 + f". Feasible: {'yes' if judged.mask[0, vehicle] else 'no'}.")
    return " ".join(lines)
