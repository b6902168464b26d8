#!/usr/bin/env bash
# To commonroad-crime a leader that brakes is one that pulls away, and who comes head-on drives ahead.
#
# TTC of the package is that of constant accelerations along the lane. It takes speed and acceleration of the other
# vehicle by their amounts. Behind a leader at the same 20 m/s that brakes with 5 m/s^2, 25.5 m ahead, TTC is sqrt(2 *
# 25.5 / 5) = 3.19 s; the package says infinity, as it does of one that accelerates. Against a car that comes at 10 m/s
# it is 25.5 / 30 = 0.85 s; the package says 2.55 s, as of one that drives away at 10 m/s. DeltaV, the change of speed in
# a plastic collision, has its sign the other way: of equal masses at 20 and 10 m/s it is 15 m/s head-on and 5 m/s from
# behind, and the package says 5 head-on and 15 from behind. Nothing is said of it in the classes. Who ranks planners by
# these sees no danger where there is most. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-crime==0.4.5 commonroad-clcs==2025.2.0 commonroad-io==2024.3 numpy==2.4.6
cd "$folder"
cat > program.py <<'PYTHON'
import math
import sys
from importlib.metadata import version

import numpy as np
from commonroad.geometry.shape import Rectangle
from commonroad.prediction.prediction import TrajectoryPrediction
from commonroad.scenario.lanelet import Lanelet, LaneletNetwork
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
from commonroad.scenario.scenario import Scenario
from commonroad.scenario.state import InitialState, KSState
from commonroad.scenario.trajectory import Trajectory
from commonroad_crime.data_structure.configuration import CriMeConfiguration
from commonroad_crime.measure import TTC, DeltaV

DT = 0.1


def car(number, start, speed, acceleration=0.0, oncoming=False):
    side = -1 if oncoming else 1
    heading = math.pi if oncoming else 0.0
    states = []
    for k in range(31):
        t = k * DT
        position = np.array([start + side * (speed * t + acceleration * t * t / 2), 0.0])
        v = speed + acceleration * t
        states.append({"time_step": k, "position": position, "orientation": heading, "velocity": v})
    shape = Rectangle(4.5, 2.0)
    initial = InitialState(**states[0], acceleration=acceleration, yaw_rate=0.0, slip_angle=0.0)
    trajectory = Trajectory(1, [KSState(**state, steering_angle=0.0) for state in states[1:]])
    return DynamicObstacle(number, ObstacleType.CAR, shape, initial, TrajectoryPrediction(trajectory, shape))


def measure(which, other):
    centre = np.stack([np.arange(0.0, 301.0, 10.0), np.zeros(31)], axis=1)
    left = np.array([0.0, 1.75])
    scenario = Scenario(DT)
    scenario.add_objects(LaneletNetwork.create_from_lanelet_list([Lanelet(centre + left, centre, centre - left, 1)]))
    scenario.add_objects([car(10, 50.0, 20.0), other])
    scenario.assign_obstacles_to_lanelets()
    configuration = CriMeConfiguration()
    configuration.update(ego_id=10, sce=scenario)
    return which(configuration).compute(vehicle_id=20, time_step=0, verbose=False)


CASES = [  # what the other one does; the measure, what it is, what comes out
    ("leader at 20 m/s brakes with 5 m/s^2", TTC, car(20, 80.0, 20.0, -5.0), math.sqrt(2 * 25.5 / 5), math.inf),
    ("leader at 20 m/s gains 5 m/s^2", TTC, car(20, 80.0, 20.0, 5.0), math.inf, math.inf),
    ("leader at 10 m/s", TTC, car(20, 80.0, 10.0), 2.55, 2.55),
    ("head-on at 10 m/s", TTC, car(20, 80.0, 10.0, oncoming=True), 0.85, 2.55),
    ("leader at 10 m/s", DeltaV, car(20, 80.0, 10.0), 5.0, 15.0),
    ("head-on at 10 m/s", DeltaV, car(20, 80.0, 10.0, oncoming=True), 15.0, 5.0),
]
print("commonroad-crime", version("commonroad-crime"), "- ego at 20 m/s, 25.5 m between the two")
same = True
for name, which, other, right, expected in CASES:
    value = measure(which, other)
    print(f"{name:36} {which.__name__:6} {value:5.4g}, is {right:.3g}")
    same = same and (value == expected or abs(value - expected) < 0.01)
sys.exit(not same)
PYTHON
venv/bin/python -W ignore program.py
