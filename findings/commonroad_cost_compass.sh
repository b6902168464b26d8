#!/usr/bin/env bash
# CommonRoad's cost functions charge a point mass by the compass, and see no parked car that faces exactly east.
#
# The same drive on the same straight lane should cost the same wherever the lane leads. For the point-mass model (PM)
# the evaluation of the drivability checker takes `velocity` for the speed, and this is the velocity along x: the path
# length of 100 m is 71 m to the north-east, 0 m to the north and -100 m to the west, the squared offset from the wanted
# speed is 0 to the east and 8000 to the west, and braking costs nothing on a lane to the north. WX1, which allows PM,
# adds these up to 1050 to the east, 929 to the north-east and 7050 to the west. The kinematic model (KS) costs the same
# everywhere. The distance to obstacles, which SA1 weighs by 100,000, leaves out rectangles whose orientation is exactly
# 0, and polygons: a car that stands in the way costs 0 on a lane to the east, and its due on one to the north or west,
# or if it is turned by a thousandth of a degree. Exits 0 as long as that is so.
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
from commonroad.geometry.shape import Circle, Polygon, Rectangle
from commonroad.planning.goal import GoalRegion
from commonroad.planning.planning_problem import PlanningProblem
from commonroad.scenario.lanelet import Lanelet, LaneletNetwork
from commonroad.scenario.obstacle import ObstacleType, StaticObstacle
from commonroad.scenario.scenario import Scenario, ScenarioID
from commonroad.scenario.state import CustomState, InitialState, KSState, PMState
from commonroad.scenario.trajectory import Trajectory
from commonroad_dc.costs.evaluation import CostFunctionEvaluator

DT = 0.1  # s


def evaluate(cost_function, degrees, model="KS", braking=0.0, shape=None, turned=0.0):
    heading = math.radians(degrees)
    along = np.array([math.cos(heading), math.sin(heading)])
    left = 5.0 * np.array([-along[1], along[0]])
    centre = np.arange(-50.0, 301.0, 5.0)[:, None] * along
    scenario = Scenario(DT, ScenarioID(country_id="DEU"))
    scenario.add_objects(LaneletNetwork.create_from_lanelet_list([Lanelet(centre + left, centre, centre - left, 1)]))
    rest = {"time_step": 0, "yaw_rate": 0.0, "slip_angle": 0.0, "acceleration": 0.0}
    if shape is not None:  # parks on the lane, 130 m from the start
        state = InitialState(position=130.0 * along, orientation=heading + math.radians(turned), velocity=0.0, **rest)
        scenario.add_objects(StaticObstacle(10, ObstacleType.PARKED_VEHICLE, shape, state))
    start = InitialState(position=np.zeros(2), orientation=heading, velocity=20.0, **rest)
    goal = GoalRegion([CustomState(time_step=Interval(0, 1000), velocity=Interval(20.0, 21.0))])
    states = []
    for k in range(51):
        t = k * DT
        place, speed = (20 * t - braking * t**2 / 2) * along, 20 - braking * t
        if model == "PM":
            state = PMState(time_step=k, position=place, velocity=speed * along[0], velocity_y=speed * along[1])
        else:
            state = KSState(time_step=k, position=place, velocity=speed, orientation=heading, steering_angle=0.0)
        states.append(state)
    evaluator = CostFunctionEvaluator(cost_function, VehicleType.BMW_320i)
    result = evaluator.evaluate_pp_solution(scenario, PlanningProblem(1, start, goal), Trajectory(0, states))
    return {term.name: float(cost) for term, cost in result.partial_costs.items()}, float(result.total_costs)


def near(costs, **expected):
    return all(abs(costs[term] - value) < 0.01 * (1 + abs(value)) for term, value in expected.items())


print("commonroad-drivability-checker", version("commonroad-drivability-checker"))
print("WX1, 5 s at 20 m/s, which is wanted: path length 100 m, squared offset from the speed 0 is expected")
print("and 5 s of braking with 2 m/s^2: squared acceleration 20 is expected (19.6: the last 0.1 s are left out)")
same = True
seen_of_pm = ((0, 100, 0, 19.6), (45, 70.7, 171.6, 9.8), (90, 0, 2000, 0), (180, -100, 8000, 19.6))
for degrees, path, offset, braking in seen_of_pm:
    for model in ("KS", "PM"):
        costs, total = evaluate(CostFunction.WX1, degrees, model)
        brakes, _ = evaluate(CostFunction.WX1, degrees, model, 2.0)
        print(f"{model}, lane at {degrees:3} degrees: path length {costs['L']:6.1f} m, ", end="")
        print(f"squared offset {costs['V']:6.1f},", end="")
        print(f" total {total:7.1f}; braking: squared acceleration {abs(brakes['A']):.1f}")
        if model == "KS":
            same = same and near(costs, L=100, V=0) and near(brakes, A=19.6) and near({"total": total}, total=1050)
        else:
            right = near({"total": total}, total=50 + 10 * path + offset)
            same = same and near(costs, L=path, V=offset) and near(brakes, A=braking) and right
print("SA1, 5 s at 20 m/s towards a parked car 130 m ahead: the same cost is expected in every row")
car, bevelled = Rectangle(4.5, 2.0), Polygon(np.array([[-2.2, -1], [2, -1], [2.3, 0], [2, 1], [-2.2, 1.0]]))
for name, degrees, shape, turned, counts in (
    ("rectangle, lane to the north", 90, car, 0.0, True),
    ("rectangle, lane to the west", 180, car, 0.0, True),
    ("rectangle, lane to the east", 0, car, 0.0, False),
    ("the same, turned by 0.001 degrees", 0, car, 0.001, True),
    ("circle, lane to the east", 0, Circle(1.5), 0.0, True),
    ("polygon, lane to the east", 0, bevelled, 0.0, False),
    ("polygon, lane to the north", 90, bevelled, 0.0, False),
):
    costs, total = evaluate(CostFunction.SA1, degrees, "KS", 0.0, shape, turned)
    print(f"{name:33}: distance to obstacles {costs['D']:.7f}, total {total:.1f}")
    same = same and (abs(costs["D"] - 0.000705) < 0.00001 if counts else costs["D"] == 0.0)
sys.exit(not same)
PYTHON
"$folder/venv/bin/python" -W ignore "$folder/program.py" 2> "$folder/errors" || { cat "$folder/errors"; exit 1; }
