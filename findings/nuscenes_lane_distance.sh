#!/usr/bin/env bash
# nuScenes' devkit takes the end of a lane of 26 m for 34.5 m along the lane, if the lane is made of ten pieces.
#
# project_pose_to_lane returns the closest pose on a lane and the distance along the lane for it. A lane is a list of
# arcline paths; each is divided evenly, into steps of the resolution or less, and gives both of its ends. The function
# multiplies the number of poses before the closest one with the resolution, so that each joint counts as a step and
# each shorter step as a full one: the end of a lane of ten pieces of 2.6 m is at 34.5 m by it, and at 26.0 m by
# length_of_lane and by the poses themselves. get_curvature_at_distance_along_lane, which takes such a distance, then
# finds the bend that lies ahead on a piece that is straight. A finer resolution makes it better. Progress along a route
# and the gap between two cars of a lane come out too long. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q nuscenes-devkit==1.2.0
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

from nuscenes.map_expansion import arcline_path_utils as arcline


def lane_of(pieces):  # pieces: (shape, radius, lengths of the three segments), one behind the other from (0, 0)
    pose, lane = (0.0, 0.0, 0.0), []
    for shape, radius, lengths in pieces:
        path = {"start_pose": list(pose), "shape": shape, "radius": radius, "segment_length": list(lengths)}
        pose = arcline.pose_at_length(path, sum(lengths))
        lane.append(path | {"end_pose": list(pose)})
    return lane, pose


print("nuscenes-devkit", version("nuscenes-devkit"))
same = True
for count, length, expected in ((1, 26.0, 26.0), (5, 5.0, 27.0), (5, 5.1, 29.5), (10, 2.6, 34.5)):
    lane, end = lane_of([("LSR", 999.999, (0.0, length, 0.0))] * count)
    pose, distance = arcline.project_pose_to_lane(end, lane)
    print(f"{count:2} pieces of {length:4} m: the end of the lane is at {distance:5.2f} m; ", end="")
    print(f"length_of_lane {arcline.length_of_lane(lane):5.2f} m, the pose found is {pose[0]:.2f} m from the start")
    same = same and distance == expected and abs(pose[0] - count * length) < 0.01
lane, _ = lane_of([("LSR", 999.999, (0.0, 5.1, 0.0))] * 4 + [("LSR", 20.0, (5.1, 0.0, 0.0))])
_, distance = arcline.project_pose_to_lane((18.0, 0.0, 0.0), lane)
found, right = (arcline.get_curvature_at_distance_along_lane(s, lane) for s in (distance, 18.0))
print(f"20.4 m of straight lane and then a bend of 20 m radius: (18, 0) is at {distance:.2f} m, ", end="")
print(f"where the curvature is {found} 1/m; at 18 m it is {right}")
sys.exit(not (same and distance > 20.4 and found == 0.05 and right == 0))
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
