#!/usr/bin/env bash
# A car of highway-env's traffic that stands 3 m behind a standing one drives backwards, into the car behind it.
#
# IDMVehicle follows the Intelligent Driver Model, whose cars stop and never reverse: the speed is bounded by 0. Here it
# is not. The wanted distance at rest is 10 m between the centres (DISTANCE_WANTED), 5 m between two cars, and whoever
# stands closer gets a negative acceleration and rolls back until it is 10 m, at up to 0.9 m/s here, without regard for
# what is behind. Even a car that comes to a standing one from afar at 20 m/s stops too late and reverses. A planner
# whose car waits in a queue is hit from the front and is told that it has crashed. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q highway-env==1.12.1 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

STEP = 1 / 15  # s, the default simulation frequency


def run(distance, speed, behind=None):  # least speed of the IDM car, its distance in the end, time of the crash
    network = RoadNetwork.straight_road_network(lanes=1, length=1000)
    road = Road(network, np_random=np.random.RandomState(0))
    leader = Vehicle(road, [200.0, 0.0], 0.0, 0.0)
    follower = IDMVehicle(road, [200.0 - distance, 0.0], 0.0, speed, target_speed=20.0)
    road.vehicles = [leader, follower]
    if behind is not None:
        waiting = Vehicle(road, [200.0 - distance - behind, 0.0], 0.0, 0.0)
        road.vehicles.append(waiting)
    slowest = speed
    for k in range(600):
        road.act()
        road.step(STEP)
        slowest = min(slowest, follower.speed)
        if behind is not None and waiting.crashed:
            return slowest, 200.0 - follower.position[0], (k + 1) * STEP
    return slowest, 200.0 - follower.position[0], None


print("highway-env", version("highway-env"))
same = True
for distance, speed, behind in ((8.0, 0.0, None), (100.0, 20.0, None), (8.0, 0.0, 6.5)):
    slowest, end, crash = run(distance, speed, behind)
    rear = f", another waits {behind - 5:.1f} m behind it" if behind else ""
    print(f"at {speed:4.1f} m/s, {distance - 5:4.1f} m behind a standing car{rear}: ", end="")
    print(f"least speed {slowest:.2f} m/s; ", end="")
    print(f"hits the car behind after {crash:.1f} s" if crash else f"is {end - 5:.1f} m behind it in the end")
    same = same and slowest < -0.2 and (crash is not None) == (behind is not None)
sys.exit(not same)
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
