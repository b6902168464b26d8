#!/usr/bin/env bash
# A spiral that scenariogeneration is asked to turn by 0.5 rad turns by 0.25, 0.75 or 1 rad if it starts in a curve.
#
# xodr.Spiral takes a length or an `angle`. The heading of a clothoid changes by the mean of its end curvatures times its
# length, so the length is 2 angle / (start + end). The package divides by the larger of the two instead, which is right
# only if the other is 0: a road from one bend into another comes out too long and points elsewhere, by 14 degrees in the
# second case below, and the OpenDRIVE file holds that length. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q scenariogeneration==0.16.7
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

from scenariogeneration import xodr

ANGLE = 0.5
# start and end curvature, 1/m: the heading that comes out, rad
CASES = {(0.0, 0.02): 0.5, (0.01, 0.02): 0.75, (0.02, 0.01): 0.75, (0.02, 0.02): 1.0, (-0.01, 0.02): 0.25}
print("scenariogeneration", version("scenariogeneration"), f"angle asked for: {ANGLE} rad")
same = True
for (start, end), expected in CASES.items():
    road = xodr.create_road([xodr.Spiral(start, end, angle=ANGLE)], 1, 1, 1)
    road.planview.adjust_geometries()
    heading = road.planview.get_end_point()[2]
    length = float(road.planview.get_element().find("geometry").get("length"))
    print(f"curvature {start:5} to {end}: length {length:5.1f} m, turns by {heading:.2f} rad; ", end="")
    print(f"{ANGLE} rad need {2 * ANGLE / (start + end):5.1f} m")
    same = same and abs(heading - expected) < 1e-6 and abs(heading - (start + end) / 2 * length) < 1e-6
sys.exit(not same)
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
