#!/usr/bin/env bash
# CommonRoad's feasibility check lets a car stop from 30 m/s within one step of 0.04 s: 750 m/s^2, as feasible.
#
# trajectory_feasibility looks for an input between two states, within the limits of the vehicle (here 11.5 m/s^2 and
# 0.4 rad/s of steering), and solution_feasible, by which solutions of the benchmark are judged, rests on it. It
# compares the place to 2 cm and the heading to 0.03 rad, whatever the step, and neither speed nor steering angle. At
# 0.1 s a jump of the speed shows as an error of the place. At 0.05 and 0.04 s, the step of scenarios from recordings at
# 25 Hz, 11.5 m/s^2 move a car by less than 2 cm, so that the speed is free: a stop at once, a jump from 10 to 30 m/s,
# and braking with 40 m/s^2 all the way are feasible. The front wheels may turn from 0.5 rad left to 0.5 rad right in
# one step at 0.1 s too, where 0.04 rad is the limit, and a car may slide sideways for ever at 1.9 cm per step. The
# inputs that are given back are within the limits, so they do not show it. Who filters planners' trajectories by the
# check lets these pass. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-drivability-checker==2025.4.0 commonroad-io==2024.3 numpy==2.4.6 \
  scipy==1.17.1
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
from commonroad_dc.feasibility.solution_checker import solution_feasible
from commonroad_dc.feasibility.vehicle_dynamics import VehicleDynamics

parameters = VehicleDynamics.KS(VehicleType.BMW_320i).parameters
REAR, BASE = parameters.b, parameters.a + parameters.b  # m, rear axle to centre and to front axle


def check(dt, speeds, steering=None, slide=0.0, mean=False):
    # each step drives at the speed of its start (mean: at the mean of both ends), on the circle of its steering angle
    steering = [0.0] * len(speeds) if steering is None else steering
    x, y, heading, states = 0.0, 0.0, 0.0, []  # of the rear axle
    for k, (speed, angle) in enumerate(zip(speeds, steering)):
        place = np.array([x + REAR * math.cos(heading), y + REAR * math.sin(heading)])
        states.append(KSState(time_step=k, position=place, velocity=float(speed), orientation=heading,
                              steering_angle=float(angle)))
        if mean and k + 1 < len(speeds):
            speed = (speed + speeds[k + 1]) / 2
        for _ in range(1000):
            x += speed * math.cos(heading) * dt / 1000
            y += speed * math.sin(heading) * dt / 1000
            heading += speed / BASE * math.tan(angle) * dt / 1000
        y += slide
    start = InitialState(time_step=0, position=states[0].position, orientation=0.0, velocity=float(speeds[0]),
                         yaw_rate=0.0, slip_angle=0.0, acceleration=0.0)
    problems = PlanningProblemSet([PlanningProblem(1, start, GoalRegion([CustomState(time_step=Interval(0, 100))]))])
    part = PlanningProblemSolution(1, VehicleModel.KS, VehicleType.BMW_320i, CostFunction.JB1, Trajectory(0, states))
    feasible, inputs, _ = solution_feasible(Solution(ScenarioID(country_id="DEU"), [part]), dt, problems)[1]
    return feasible, max(abs(state.acceleration) for state in inputs.state_list)


print("commonroad-drivability-checker", version("commonroad-drivability-checker"), end="; limits: ")
print(parameters.longitudinal.a_max, "m/s^2,", parameters.steering.v_max, "rad/s")
same = True
for dt in (0.1, 0.05, 0.04):
    short = dt < 0.1
    ramp = np.arange(10) * dt
    for name, expected, seen, arguments in (
        ("steady 20 m/s", True, True, {"speeds": [20] * 10}),
        ("braking with 8 m/s^2", True, True, {"speeds": 20 - 8 * ramp, "mean": True}),
        ("5 m/s, wheels at 0.5 rad", True, True, {"speeds": [5] * 10, "steering": [0.5] * 10}),
        ("20 m/s, 3 cm sideways per step", False, False, {"speeds": [20] * 10, "slide": 0.03}),
        ("braking with 40 m/s^2", False, short, {"speeds": 30 - 40 * ramp}),
        ("30 m/s, then 0", False, short, {"speeds": [30] * 5 + [0] * 5}),
        ("10 m/s, then 30 m/s", False, short, {"speeds": [10] * 5 + [30] * 5}),
        ("5 m/s, wheels 0.5, then -0.5 rad", False, True, {"speeds": [5] * 10, "steering": [0.5] * 5 + [-0.5] * 5}),
        ("20 m/s, 1.9 cm sideways per step", False, True, {"speeds": [20] * 10, "slide": 0.019}),
    ):
        feasible, largest = check(dt, **arguments)
        print(f"step {dt:4} s, {name:32}: {'feasible' if feasible else 'infeasible':10}", end="")
        print(f" ({'feasible' if expected else 'infeasible'} is expected), ", end="")
        print(f"largest acceleration given back {largest:4.1f} m/s^2")
        same = same and feasible == seen and largest < 11.6
sys.exit(not same)
PYTHON
"$folder/venv/bin/python" -W ignore "$folder/program.py" 2> "$folder/errors" || { cat "$folder/errors"; exit 1; }
