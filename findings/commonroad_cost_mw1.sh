#!/usr/bin/env bash
# CommonRoad's cost function MW1 weighs a lateral jerk that is a lateral speed, and a duration that is always 0.1 s.
#
# MW1 is one of the benchmark's cost functions: 5 times the squared lateral jerk, 0.5 times the squared longitudinal
# jerk, 0.2 times the squared offset from the wanted speed, and one over the duration. The drivability checker, which
# evaluates solutions by it, has all four wrong. The lateral jerk is the first derivative of the lateral position, not
# the third one: a steady drift of 0.3 m/s costs as long as it lasts, and a swerve that is 3 times as fast costs 8 times
# as much, where it is 3^6 = 729. One over the duration is 1 / min(T, 0.1): 10 for 2 s as for 10 s. The longitudinal
# jerk of steady braking is 0, and costs more than a real change between 20 and 15 m/s, as the two ends of the
# trajectory are read as jumps; it is right if there is no acceleration at the ends. The offset from the speed is 0 at
# 10 m/s as at 30 m/s where the goal asks for 20 to 21 m/s (the source marks it as to be done). Exits 0 as long as that
# is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-drivability-checker==2025.4.0 commonroad-clcs==2025.2.0 \
  commonroad-io==2024.3 numpy==2.4.6 scipy==1.17.1
cat > "$folder/program.py" <<'PYTHON'
import math
import sys
from importlib.metadata import version

import numpy as np
from commonroad.common.solution import CostFunction, VehicleType
from commonroad.common.util import Interval
from commonroad.planning.goal import GoalRegion
from commonroad.planning.planning_problem import PlanningProblem
from commonroad.scenario.lanelet import Lanelet, LaneletNetwork
from commonroad.scenario.scenario import Scenario, ScenarioID
from commonroad.scenario.state import CustomState, InitialState, KSState
from commonroad.scenario.trajectory import Trajectory
from commonroad_dc.costs.evaluation import CostFunctionEvaluator

DT = 0.1  # s
x = np.arange(-50.0, 551.0, 5.0)
centre, left = np.stack([x, 0 * x], axis=1), np.array([0.0, 5.0])
scenario = Scenario(DT, ScenarioID(country_id="DEU"))
scenario.add_objects(LaneletNetwork.create_from_lanelet_list([Lanelet(centre + left, centre, centre - left, 1)]))
start = InitialState(time_step=0, position=np.zeros(2), orientation=0.0, velocity=20.0, yaw_rate=0.0, slip_angle=0.0,
                     acceleration=0.0)
goal = GoalRegion([CustomState(time_step=Interval(0, 1000), velocity=Interval(20.0, 21.0))])
problem = PlanningProblem(1, start, goal)


def terms(duration, place, speed):  # place and speed give (x, y) and (v_x, v_y) at a time
    states = []
    for k in range(round(duration / DT) + 1):
        v = speed(k * DT)
        states.append(KSState(time_step=k, position=np.array(place(k * DT)), velocity=math.hypot(*v),
                              orientation=math.atan2(v[1], v[0]), steering_angle=0.0))
    evaluator = CostFunctionEvaluator(CostFunction.MW1, VehicleType.BMW_320i)
    costs = evaluator.evaluate_pp_solution(scenario, problem, Trajectory(0, states)).partial_costs
    return [float(costs[term]) for term in sorted(costs, key=lambda term: term.name)]  # ID, Jlat, Jlon, Vlon


def drift(v):
    return lambda t: (20 * t, v * t), lambda t: (20.0, v)


def swerve(a, w):
    return lambda t: (20 * t, a * math.sin(w * t)), lambda t: (20.0, a * w * math.cos(w * t))


def steady(v):
    return lambda t: (v * t, 0.0), lambda t: (v, 0.0)


def brake(a):
    return lambda t: (20 * t - a * t**2 / 2, 0.0), lambda t: (20 - a * t, 0.0)


def breathe(period):  # from 20 to 15 m/s and back, with no acceleration at either end
    w = turn / period
    return lambda t: (17.5 * t + 2.5 / w * math.sin(w * t), 0.0), lambda t: (17.5 + 2.5 * math.cos(w * t), 0.0)


turn = 2 * math.pi
print("commonroad-drivability-checker", version("commonroad-drivability-checker"), "- terms of MW1, seen (expected)")
rows = []
for name, duration, motion, jerk_lateral, jerk, offset in (
    ("20 m/s for 2 s", 2.0, steady(20.0), 0, 0, 0),
    ("20 m/s for 10 s", 10.0, steady(20.0), 0, 0, 0),
    ("10 m/s for 10 s", 10.0, steady(10.0), 0, 0, 1000),
    ("30 m/s for 10 s", 10.0, steady(30.0), 0, 0, 1000),
    ("drift of 0.3 m/s for 5 s", 5.0, drift(0.3), 0, 0, 0),
    ("drift of 0.3 m/s for 10 s", 10.0, drift(0.3), 0, 0, 0),
    ("swerve, 0.3 m, 6 s each", 12.0, swerve(0.3, turn / 6), 6 * (0.3 * (turn / 6) ** 3) ** 2, 0, 0),
    ("swerve, 0.3 m, 2 s each", 12.0, swerve(0.3, turn / 2), 6 * (0.3 * (turn / 2) ** 3) ** 2, 0, 0),
    ("braking, 2 m/s^2", 5.0, brake(2.0), 0, 0, None),
    ("braking, 4 m/s^2", 5.0, brake(4.0), 0, 0, None),
    ("20, 15, 20 m/s in 10 s", 10.0, breathe(10.0), 0, 10 * (2.5 * (turn / 10) ** 2) ** 2 / 2, None),
    ("20, 15, 20 m/s in 6 s", 6.0, breathe(6.0), 0, 6 * (2.5 * (turn / 6) ** 2) ** 2 / 2, None),
):
    seen = terms(duration, *motion)
    expected = (1 / duration, jerk_lateral, jerk, offset)
    text = []
    for term, value, right in zip(("1/T", "lateral jerk", "longitudinal jerk", "speed"), seen, expected):
        text.append(f"{term} {abs(round(value, 3)):.3g}" + (f" ({right:.3g})" if right is not None else ""))
    print(f"{name:25}:", ", ".join(text))
    rows.append(seen)
same = all(row[0] == 10.0 and row[3] == 0.0 for row in rows)
same = same and all(abs(row[1]) < 1e-6 for row in rows[:4] + rows[8:])
same = same and abs(rows[4][1] - 0.45) < 0.01 and abs(rows[5][1] - 0.9) < 0.01  # 0.3^2 times the duration
same = same and abs(rows[6][1] / (6 * (0.3 * turn / 6) ** 2) - 1) < 0.05  # the squared lateral speed
same = same and 7 < rows[7][1] / rows[6][1] < 9
same = same and all(abs(row[2]) < 1e-6 for row in rows[:8]) and rows[8][2] > 5 and rows[9][2] > 25
same = same and abs(rows[10][2] / 4.87 - 1) < 0.1 and abs(rows[11][2] / 22.5 - 1) < 0.1  # these two are right
sys.exit(not same)
PYTHON
"$folder/venv/bin/python" -W ignore "$folder/program.py" 2> "$folder/errors" || { cat "$folder/errors"; exit 1; }
