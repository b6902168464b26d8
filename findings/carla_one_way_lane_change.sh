#!/usr/bin/env bash
# CARLA allows a lane change to the right just where the OpenDRIVE file forbids it, at a line that is crossed one way.
#
# A road mark's laneChange="increase" allows changes to lanes of higher id only, "decrease" to lower ones only; ids rise
# from right to left. Of lanes -1 and -2 with such a line between them, carla.Map lets vehicles change from -1 to -2 at
# "increase" and not at "decrease": both are the wrong way round. From -2 to -1 it is right, and so are "both" and
# "none". Needs no simulator: the client reads the map by itself. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q carla==0.9.16
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import carla

FILE = """<?xml version="1.0"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="7" name="changes" north="10" south="-10" east="110" west="-10">
    <geoReference><![CDATA[+proj=tmerc +lat_0=49 +lon_0=8 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m]]></geoReference>
  </header>
  <road name="r" id="1" length="100" junction="-1" rule="RHT">
    <link/>
    <planView><geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry></planView>
    <lanes><laneSection s="0">
      <center><lane id="0" type="none" level="false">
        <roadMark sOffset="0" type="solid" color="white" laneChange="none"/>
      </lane></center>
      <right>
        <lane id="-1" type="driving" level="false"><link/><width sOffset="0" a="3.5" b="0" c="0" d="0"/>
          <roadMark sOffset="0" type="broken" color="white" laneChange="{}"/></lane>
        <lane id="-2" type="driving" level="false"><link/><width sOffset="0" a="3.5" b="0" c="0" d="0"/>
          <roadMark sOffset="0" type="solid" color="white" laneChange="none"/></lane>
      </right>
    </laneSection></lanes>
  </road>
</OpenDRIVE>
"""
# laneChange: whether the file allows -1 to -2, and -2 to -1
RULES = {"both": (True, True), "none": (False, False), "increase": (False, True), "decrease": (True, False)}
ONE_WAY = ("increase", "decrease")
print("carla", version("carla"))
same = True
for change, allowed in RULES.items():
    world = carla.Map("changes", FILE.format(change))
    right = bool(int(world.get_waypoint_xodr(1, -1, 50.0).lane_change) & int(carla.LaneChange.Right))
    left = bool(int(world.get_waypoint_xodr(1, -2, 50.0).lane_change) & int(carla.LaneChange.Left))
    print(f"{change:8}: -1 to -2 and -2 to -1: by the file {allowed}, by CARLA {(right, left)}")
    same = same and left == allowed[1] and (right != allowed[0]) == (change in ONE_WAY)
sys.exit(not same)
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
