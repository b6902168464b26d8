#!/usr/bin/env bash
# CommonRoad's check that a solution starts where its problem starts allows 10 cm at the origin and 50 m in UTM.
#
# starts_at_correct_state is one of the checks by which solutions of the benchmark are valid. It compares place and
# heading by numpy.allclose with atol=0.1, and leaves the relative tolerance at its default, so 1e-5 of each coordinate
# is allowed on top: in UTM coordinates, with 5335 km to the north, a car that starts 50 m ahead of its place starts
# correctly, and one that is 1 m off to the east and to the north as well. The same two near the origin are refused. On
# the other side the heading is compared as a number: a solution that has -pi where the problem has pi is refused,
# though both face west. It matters to whoever checks planners on maps that were not moved to the origin. Exits 0 as
# long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-drivability-checker==2025.4.0 commonroad-io==2024.3 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import math
import sys
from importlib.metadata import version

import numpy as np
from commonroad.common.solution import CostFunction, PlanningProblemSolution, Solution, VehicleModel, VehicleType
from commonroad.common.util import Interval
from commonroad.planning.goal import GoalRegion
from commonroad.planning.planning_problem import PlanningProblem, PlanningProblemSet
from commonroad.scenario.scenario import ScenarioID
from commonroad.scenario.state import CustomState, InitialState, KSState
from commonroad.scenario.trajectory import Trajectory
from commonroad_dc.feasibility.solution_checker import SolutionCheckerException, starts_at_correct_state


def accepted(origin, off, heading=math.pi / 2, solved=math.pi / 2):
    start = InitialState(time_step=0, position=np.array(origin), orientation=heading, velocity=10.0, yaw_rate=0.0,
                         slip_angle=0.0, acceleration=0.0)
    problem = PlanningProblem(1, start, GoalRegion([CustomState(time_step=Interval(0, 100))]))
    states = []
    for k in range(11):
        place = np.array(origin) + off + k * np.array([math.cos(solved), math.sin(solved)])
        states.append(KSState(time_step=k, position=place, velocity=10.0, orientation=solved, steering_angle=0.0))
    part = PlanningProblemSolution(1, VehicleModel.KS, VehicleType.BMW_320i, CostFunction.JB1, Trajectory(0, states))
    try:
        return starts_at_correct_state(Solution(ScenarioID(country_id="DEU"), [part]), PlanningProblemSet([problem]))
    except SolutionCheckerException:
        return False


print("commonroad-drivability-checker", version("commonroad-drivability-checker"))
same = True
for name, origin in (("origin", (0.0, 0.0)), ("UTM", (690000.0, 5335000.0))):
    for off, near, far in (
        ((0.0, 0.0), True, True), ((0.05, 0.05), True, True), ((0.0, 0.2), False, True), ((1.0, 1.0), False, True),
        ((6.9, 0.0), False, True), ((0.0, 50.0), False, True), ((8.0, 0.0), False, False), ((0.0, 60.0), False, False),
    ):
        seen = accepted(origin, np.array(off))
        print(f"{name:6}: start {off[0]:4} m east and {off[1]:4} m north of its place:", end=" ")
        print("accepted" if seen else "refused")
        same = same and seen == (far if name == "UTM" else near)
for heading, solved, expected in ((math.pi, math.pi, True), (math.pi, -math.pi, False), (-3.13, 3.13, False)):
    seen = accepted((0.0, 0.0), np.zeros(2), heading, solved)
    print(f"heading {heading:6.3f} of the problem, {solved:6.3f} of the solution: {'accepted' if seen else 'refused'}")
    same = same and seen == expected
sys.exit(not same)
PYTHON
"$folder/venv/bin/python" -W ignore "$folder/program.py" 2> "$folder/errors" || { cat "$folder/errors"; exit 1; }
