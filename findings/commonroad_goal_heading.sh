#!/usr/bin/env bash
# commonroad-io judges a point mass at its goal by a heading that it does not have.
#
# The goal of a planning problem may ask for an orientation, and a state of the point-mass model (PM) has none but its two
# velocities, so GoalRegion.is_reached derives it. It first sets the velocity along x to the speed and takes the heading
# of (speed, velocity_y) then: a vehicle at (3, 4) m/s heads at 0.93 rad and is taken to head at 0.67 rad, and one that
# drives backwards along x passes for one that drives forwards. PMState.orientation itself is right, and so is the answer
# for a state that gives speed and orientation. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-io==2026.1
cat > "$folder/program.py" <<'PYTHON'
import math
import sys
from importlib.metadata import version

import numpy
from commonroad.common.util import AngleInterval, Interval
from commonroad.planning.goal import GoalRegion
from commonroad.scenario.state import CustomState, PMState

PLACE = numpy.array([0.0, 0.0])


def reached(state, heading):
    """Whether a goal within 0.05 rad of the heading is reached."""
    wanted = AngleInterval(heading - 0.05, heading + 0.05)
    return bool(GoalRegion([CustomState(time_step=Interval(0, 10), orientation=wanted)]).is_reached(state))


print("commonroad-io", version("commonroad-io"))
same = True
for x, y in ((3.0, 4.0), (3.0, -4.0), (0.5, 4.0), (-5.0, 0.1)):
    point = PMState(time_step=5, position=PLACE, velocity=x, velocity_y=y)
    true, speed = math.atan2(y, x), math.hypot(x, y)
    other = math.atan2(y, speed)
    full = CustomState(time_step=5, position=PLACE, velocity=speed, orientation=true)
    found = reached(point, true), reached(point, other), reached(full, true), reached(full, other)
    print(f"({x:+.1f}, {y:+.1f}) m/s, heading {true:+.2f}: point mass reaches a goal at {true:+.2f}: {found[0]}, ", end="")
    print(f"at {other:+.2f}: {found[1]}; with an orientation: {found[2]}, {found[3]}")
    same = same and found == (False, True, True, False) and math.isclose(point.orientation, true)
sys.exit(not same)
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
