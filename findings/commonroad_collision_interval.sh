#!/usr/bin/env bash
# CommonRoad's collision checker takes an area that is occupied from step 1 to 5 for one that is free from step 2 on.
#
# A CommonRoad file gives the time of an occupancy of a dynamic obstacle as a step or as an interval of steps, and
# occupancy_at_time of commonroad-io keeps to both. create_collision_checker of the drivability checker takes the
# occupancies of a prediction in their order, one for each step after the initial one, and reads no times. A set-based
# prediction in two intervals of 5 steps is over after 2 steps, so a planner's car that stands in the area at step 4
# does not collide; and it does at step 2 with what will be there at step 6. A prediction, by sets or by a trajectory,
# that starts some steps after the initial state is checked at the wrong time as well. Phantom obstacles (who may come
# out of where the car cannot see) and environment obstacles (buildings) are left out, though they have an occupancy. A
# prediction with one occupancy per step is right, and so is a trajectory from step 1 on. Nothing is said of it. Exits 0
# as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-drivability-checker==2025.4.0 commonroad-io==2024.3 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
from commonroad.common.util import Interval
from commonroad.geometry.shape import Circle, Polygon, Rectangle
from commonroad.prediction.prediction import Occupancy, SetBasedPrediction, TrajectoryPrediction
from commonroad.scenario.obstacle import DynamicObstacle, EnvironmentObstacle, ObstacleType, PhantomObstacle
from commonroad.scenario.scenario import Scenario
from commonroad.scenario.state import InitialState, KSState
from commonroad.scenario.trajectory import Trajectory
from commonroad_dc.collision.collision_detection.pycrcc_collision_dispatch import (
    create_collision_checker,
    create_collision_object,
)
from commonroad_dc.pycrcc import TimeVariantCollisionObject

STEPS = 12
PLACES = {"A": 10.0, "B": 20.0}  # m, along x
start = InitialState(time_step=0, position=np.zeros(2), orientation=0.0, velocity=0.0, yaw_rate=0.0, slip_angle=0.0,
                     acceleration=0.0)


def area(place):
    return Rectangle(4.0, 2.0, np.array([PLACES[place], 0.0]), 0.0)


def sets(first, occupancies):
    return SetBasedPrediction(first, [Occupancy(time, area(place)) for time, place in occupancies])


def states(first, last):  # a car that stands at A up to step 5, and at B then
    list_of_states = []
    for k in range(first, last + 1):
        place = np.array([PLACES["A" if k <= 5 else "B"], 0.0])
        list_of_states.append(KSState(time_step=k, position=place, orientation=0.0, velocity=0.0, steering_angle=0.0))
    return TrajectoryPrediction(Trajectory(first, list_of_states), Rectangle(4.0, 2.0))


def car(prediction):
    return DynamicObstacle(5, ObstacleType.CAR, Rectangle(4.0, 2.0), start, prediction)


def letters(occupied):
    text = ""
    for step in range(STEPS):
        found = [name for name, x in PLACES.items() if occupied(step, Circle(0.5, np.array([x, 0.0])))]
        text += (found or ["."])[0]
    return text


def by_checker(obstacle):
    scenario = Scenario(0.1)
    scenario.add_objects(obstacle)
    checker = create_collision_checker(scenario)

    def occupied(step, ego):
        moving = TimeVariantCollisionObject(step)
        moving.append_obstacle(create_collision_object(ego))
        return checker.collide(moving)

    return letters(occupied)


def by_file_format(obstacle):
    def occupied(step, ego):
        occupancy = obstacle.occupancy_at_time(step)
        return occupancy is not None and occupancy.shape.shapely_object.intersects(ego.shapely_object)

    return letters(occupied)


print("commonroad-drivability-checker", version("commonroad-drivability-checker"), end=", ")
print("commonroad-io", version("commonroad-io"), "- the area that is occupied at steps 0 to 11")
steps = [(k, "A" if k <= 5 else "B") for k in range(1, 11)]
house = Polygon(np.array([[8.0, -1.0], [12.0, -1.0], [12.0, 1.0], [8.0, 1.0]]))
same = True
for name, obstacle, expected, wrong in (
    ("sets, one per step", car(sets(1, steps)), ".AAAAABBBBB.", None),
    ("trajectory from step 1", car(states(1, 10)), ".AAAAABBBBB.", None),
    ("sets, steps 1 to 5 and 6 to 10", car(sets(1, [(Interval(1, 5), "A"), (Interval(6, 10), "B")])),
     ".AAAAABBBBB.", ".AB........."),
    ("sets, one per step from step 4", car(sets(4, steps[3:])), "....AABBBBB.", ".AABBBBB...."),
    ("trajectory from step 4", car(states(4, 10)), "....AABBBBB.", ".AABBBBB...."),
    ("phantom obstacle", PhantomObstacle(5, sets(1, steps)), ".AAAAABBBBB.", "............"),
    ("environment obstacle", EnvironmentObstacle(5, ObstacleType.BUILDING, house), "AAAAAAAAAAAA", "............"),
):
    seen, right = by_checker(obstacle), by_file_format(obstacle)
    print(f"{name:31}: occupancy_at_time {right}, collision checker {seen}")
    same = same and right == expected and seen == (wrong or expected)
sys.exit(not same)
PYTHON
"$folder/venv/bin/python" -W ignore "$folder/program.py" 2> "$folder/errors" || { cat "$folder/errors"; exit 1; }
