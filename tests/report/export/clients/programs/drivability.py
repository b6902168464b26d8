"""CommonRoad's drivability checker: the first step at which the ego, obstacle 1,
collides, in each file."""

import json
import sys

from commonroad.common.file_reader import CommonRoadFileReader
from commonroad_dc.collision.collision_detection.pycrcc_collision_dispatch import (
    create_collision_checker,
    create_collision_object,
)

for file in sys.argv[1:]:
    scenario, _ = CommonRoadFileReader(file).open()
    ego = scenario.obstacle_by_id(1)
    scenario.remove_obstacle(ego)
    checker = create_collision_checker(scenario)
    driven = create_collision_object(ego)
    steps = range(ego.prediction.final_time_step + 1)
    hit = (
        k
        for k in steps
        if driven.obstacle_at_time(k)
        and checker.time_slice(k).collide(driven.obstacle_at_time(k))
    )
    print("answer:", json.dumps(next(hit, None)))
