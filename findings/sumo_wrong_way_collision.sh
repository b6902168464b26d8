#!/usr/bin/env bash
# SUMO's collision check turns a car that drives the wrong way round: one that stops 4 m before another has crashed.
#
# moveToXY places a car by its front bumper and an angle, and getPosition, getAngle and the FCD output give both back. A
# car that is put on a lane to the east with its nose to the west has its body to the east of that point. The collision
# check has it to the west, as of a car that drives along the lane. So a car in co-simulation that overtakes on the
# wrong side and stops nose to nose with oncoming traffic, 4 m from it, has collided; one that backs along the lane into
# the tail of another has not, though 4.5 m of the two are in the same place. Nothing is said of it. Exits 0 as long as
# that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q eclipse-sumo==1.28.0 libsumo==1.28.0
export SUMO_HOME; SUMO_HOME=$(echo "$folder"/venv/lib/python3*/site-packages/sumo)
cat > "$folder/road.nod.xml" <<'XML'
<nodes><node id="west" x="0" y="0"/><node id="east" x="200" y="0"/></nodes>
XML
cat > "$folder/road.edg.xml" <<'XML'
<edges><edge id="road" from="west" to="east" speed="30"/><edge id="back" from="east" to="west" speed="30"/></edges>
XML
cd "$folder"
"$folder/venv/bin/netconvert" -n road.nod.xml -e road.edg.xml -o road.net.xml > /dev/null
cat > program.py <<'PYTHON'
import sys

import libsumo

LENGTH = 5.0  # m, of SUMO's default car


def crash(nose, angle):  # car "a" faces east with its nose at 100; nose and angle of car "b"
    options = ["--step-length", "0.1", "--no-step-log", "--no-warnings", "--collision.action", "warn"]
    options += ["--collision.check-junctions", "--collision.mingap-factor", "0"]
    libsumo.start(["sumo", "-n", "road.net.xml", *options])
    libsumo.route.add("along", ["road"])
    y = libsumo.lane.getShape("road_0")[0][1]
    seen = False
    for name, place in (("a", "50"), ("b", "80" if nose > 97.5 else "20")):  # in their order on the lane
        libsumo.vehicle.add(name, "along", departPos=place, departSpeed="0")
        libsumo.simulationStep()
    for _ in range(5):
        libsumo.vehicle.moveToXY("a", "", 0, 100.0, y, angle=90, keepRoute=2)
        libsumo.vehicle.moveToXY("b", "", 0, nose, y, angle=angle, keepRoute=2)
        libsumo.simulationStep()
        seen = seen or len(libsumo.simulation.getCollisions()) > 0
    back = (libsumo.vehicle.getPosition("b")[0], libsumo.vehicle.getAngle("b"), libsumo.vehicle.getLaneID("b"))
    assert back == (nose, angle, "road_0"), back
    libsumo.close()
    return seen


print(libsumo.getVersion()[1])
same = True
for nose, angle, expected in (
    (94.0, 90, False), (96.0, 90, True), (106.0, 90, False), (104.0, 90, True),
    (106.0, 270, False), (104.0, 270, True), (99.0, 270, True), (94.5, 270, False), (91.0, 270, False),
):
    body = (nose, nose + LENGTH) if angle == 270 else (nose - LENGTH, nose)
    gap = max(body[0] - 100.0, 100.0 - LENGTH - body[1])
    seen = crash(nose, angle)
    print(f"a faces east, from 95 to 100 m; b faces {'west' if angle == 270 else 'east'}, ", end="")
    print(f"from {body[0]:5.1f} to {body[1]:5.1f} m: {'gap' if gap > 0 else 'overlap'} {abs(gap):.1f} m, ", end="")
    print("collision" if seen else "no collision")
    same = same and seen == expected
sys.exit(not same)
PYTHON
"$folder/venv/bin/python" program.py
