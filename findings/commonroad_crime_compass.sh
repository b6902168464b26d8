#!/usr/bin/env bash
# commonroad-crime's time to collision is a matter of the compass: 2.55 s to the east, 1.15 s to the west, none to the north.
#
# A car at 20 m/s follows one at 10 m/s on a straight lane, with 25.5 m between the two: TTC is 2.55 s and the brake
# threat number (10^2 / (2 * 25.5)) / 11.5 = 0.17, whichever way the lane leads. The headway HW of the package takes
# half a length from x and from y of a position, not along the lane, and so adds 9 m to the gap of two cars that drive
# westwards. TTC and ALongReq project the speeds on the x axis (cosine of the lane's direction), so that nobody moves on
# a lane to the north, and ALongReq takes a direction of exactly 0 for a missing one: BTN is 0 to the east. TET, TIT,
# AReq and others are built on these. Who compares planners by them on a map of the real world compares streets. Exits 0
# as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-crime==0.4.5 commonroad-clcs==2025.2.0 commonroad-io==2024.3 numpy==2.4.6
cd "$folder"
cat > program.py <<'PYTHON'
import math
import sys
import warnings
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
from commonroad_crime.measure import BTN, HW, TTC

DT = 0.1


def car(number, start, speed, heading):
    along = np.array([math.cos(heading), math.sin(heading)])
    states = [
        {"time_step": k, "position": (start + speed * k * DT) * along, "orientation": heading, "velocity": speed}
        for k in range(31)
    ]
    shape = Rectangle(4.5, 2.0)
    initial = InitialState(**states[0], acceleration=0.0, yaw_rate=0.0, slip_angle=0.0)
    trajectory = Trajectory(1, [KSState(**state, steering_angle=0.0) for state in states[1:]])
    return DynamicObstacle(number, ObstacleType.CAR, shape, initial, TrajectoryPrediction(trajectory, shape))


def measures(degrees):
    heading = math.radians(degrees)
    along = np.array([math.cos(heading), math.sin(heading)])
    left = 1.75 * np.array([-along[1], along[0]])
    centre = np.arange(0.0, 301.0, 10.0)[:, None] * along
    scenario = Scenario(DT)
    scenario.add_objects(LaneletNetwork.create_from_lanelet_list([Lanelet(centre + left, centre, centre - left, 1)]))
    scenario.add_objects([car(10, 50.0, 20.0, heading), car(20, 80.0, 10.0, heading)])
    scenario.assign_obstacles_to_lanelets()
    values = []
    for measure in (HW, TTC, BTN):
        configuration = CriMeConfiguration()
        configuration.update(ego_id=10, sce=scenario)
        values.append(measure(configuration).compute(vehicle_id=20, time_step=0, verbose=False))
    return values


warnings.simplefilter("ignore")  # of numpy's polyfit, on lanes to the north
print("commonroad-crime", version("commonroad-crime"), "- expected: HW 25.5 m, TTC 2.55 s, BTN 0.1705 in every direction")
seen = {}
for degrees in (0, 45, 90, 135, 180):
    seen[degrees] = measures(degrees)
    print("lane at {:3} degrees: HW {:5.2f} m, TTC {:9.4g} s, BTN {:.4f}".format(degrees, *seen[degrees]))
same = abs(seen[0][0] - 25.5) < 0.05 and abs(seen[180][0] - 34.5) < 0.05
same = same and abs(seen[0][1] - 2.55) < 0.01 and abs(seen[180][1] - 1.15) < 0.01 and seen[90][1] > 1e6
same = same and seen[0][2] == 0 and seen[90][2] == 0 and seen[180][2] > 0.1
sys.exit(not same)
PYTHON
venv/bin/python -W ignore program.py
