#!/usr/bin/env bash
# SUMO's FCD output has who rides in a car as a person of the street, at its front bumper, and not inside of it.
#
# SUMO's page on FCD says that persons transported within a vehicle are written as child elements of that vehicle. They
# are its neighbours in the file, as who walks is, with the vehicle's x, y, angle and speed and an edge of the road. What
# tells them apart, the attribute `vehicle`, is not written by default. A reader that takes persons for pedestrians sees one
# run over by each taxi, all the way. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q eclipse-sumo==1.28.0
export SUMO_HOME; SUMO_HOME=$(echo "$folder"/venv/lib/python3*/site-packages/sumo)
cat > "$folder/trips.rou.xml" <<'XML'
<routes>
  <person id="rider" depart="0" departPos="60"><ride from="A0A1" to="B1C1" lines="taxi"/></person>
  <vehicle id="taxi" depart="1"><route edges="A0A1 A1B1 B1C1"/><stop lane="A0A1_0" endPos="60" duration="2"/></vehicle>
</routes>
XML
"$folder/venv/bin/netgenerate" --grid --grid.number 3 --seed 1 -o "$folder/n.net.xml" > /dev/null
"$folder/venv/bin/sumo" -n "$folder/n.net.xml" -r "$folder/trips.rou.xml" --fcd-output "$folder/fcd.xml" --end 40 --no-step-log
"$folder/venv/bin/sumo" --version | sed -n 1p
python3 - "$folder/fcd.xml" <<'PYTHON'
import sys
from xml.etree import ElementTree

inside, beside, told = 0, 0, 0
for step in ElementTree.parse(sys.argv[1]).getroot():
    inside += len(step.findall("vehicle/person"))
    taxi = step.find("vehicle[@id='taxi']")
    for person in step.findall("person"):
        if taxi is not None and float(taxi.get("speed")) > 1:
            place = [person.get(name) == taxi.get(name) for name in ("x", "y", "angle", "speed")]
            beside += all(place)
            told += person.get("vehicle") is not None
print(f"steps in which the taxi drives and the rider is: inside of its element {inside}, beside it {beside}, told {told}")
sys.exit(not (inside == 0 and beside > 10 and told == 0))
PYTHON
