#!/usr/bin/env bash
# netconvert draws a lane offset of an OpenDRIVE file as a straight line, 2.5 m beside the lane.
#
# OpenDRIVE's laneOffset is a cubic of s, by which the lanes are moved sideways. netconvert drops the points of a piece of
# road that lie in a line, and computes the offset at those that are left: an offset of 0.001 s^2 over 100 m of straight
# road makes a lane of two points, whatever --opendrive.curve-resolution says. Let the same road rise along a parabola by
# 1 m, and its points are kept, and the lane is where it belongs. Nothing is said of it. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q eclipse-sumo==1.28.0

write() { # FILE ELEVATION
  cat > "$1" <<XML
<?xml version="1.0"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="7" name="offset" north="10" south="-10" east="110" west="-10"/>
  <road name="r" id="1" length="100" junction="-1" rule="RHT">
    <link/>
    <planView><geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry></planView>
    <elevationProfile>$2</elevationProfile>
    <lanes>
      <laneOffset s="0" a="0" b="0" c="0.001" d="0"/>
      <laneSection s="0">
        <center><lane id="0" type="none" level="false"/></center>
        <right><lane id="-1" type="driving" level="false"><link/><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>
      </laneSection>
    </lanes>
  </road>
</OpenDRIVE>
XML
}
write "$folder/flat.xodr" ''
write "$folder/rise.xodr" '<elevation s="0" a="0" b="0" c="0.0001" d="0"/>'
"$folder/venv/bin/netconvert" --version | sed -n 1p
for kind in flat rise; do
  "$folder/venv/bin/netconvert" --opendrive-files "$folder/$kind.xodr" -o "$folder/$kind.net.xml"
done
python3 - "$folder" <<'PYTHON'
import re
import sys
from pathlib import Path

found = {}
for kind in ("flat", "rise"):
    text = Path(sys.argv[1], f"{kind}.net.xml").read_text()
    shape = re.search(r'<lane id="-1_0"[^>]* shape="([^"]*)"', text)[1]
    points = [tuple(map(float, point.split(",")[:2])) for point in shape.split()]
    for (x0, y0), (x1, y1) in zip(points, points[1:]):
        if x0 <= 50 <= x1:
            found[kind] = y0 + (50 - x0) / (x1 - x0) * (y1 - y0)
    print(f"{kind}: {len(points)} points, middle of the lane at s = 50: y = {found[kind]:.2f} m, by the file 0.75 m")
sys.exit(not (abs(found["flat"] - 3.25) < 0.05 and abs(found["rise"] - 0.75) < 0.05))
PYTHON
