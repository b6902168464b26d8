#!/usr/bin/env bash
# CARLA gives a signal of an OpenDRIVE file to the traffic of the other direction.
#
# OpenDRIVE: orientation="+" means that a signal is valid for traffic in the road's positive s direction, "-" for the
# other. Where the signal has no <validity>, which is optional, carla.Map makes "+" valid for the lanes of positive ids,
# and these are driven against s where traffic keeps right. So a limit is seen by the vehicles that drive away from it,
# and those that it is for see none. Needs no simulator: the client reads the map by itself. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q carla==0.9.16
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import carla

LANE = '<lane id="{}" type="driving" level="false"><link/><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>'
FILE = f"""<?xml version="1.0"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="7" name="signals" north="10" south="-10" east="110" west="-10">
    <geoReference><![CDATA[+proj=tmerc +lat_0=49 +lon_0=8 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m]]></geoReference>
  </header>
  <road name="r" id="1" length="100" junction="-1" rule="RHT">
    <link/>
    <planView><geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry></planView>
    <lanes><laneSection s="0">
      <left>{LANE.format(1)}</left>
      <center><lane id="0" type="none" level="false"/></center>
      <right>{LANE.format(-1)}</right>
    </laneSection></lanes>
    <signals>
      <signal name="limit" id="7" s="50" t="-4" dynamic="no" orientation="+" zOffset="2" country="DE" type="274"
        subtype="-1" value="50" unit="km/h" height="0.6" width="0.6"/>
    </signals>
  </road>
</OpenDRIVE>
"""
world = carla.Map("signals", FILE)
print("carla", version("carla"), "a limit with orientation '+' at s = 50")
seen = {}
for lane, start in ((-1, 20.0), (1, 80.0)):
    place = world.get_waypoint_xodr(1, lane, start)
    ahead = place.next(10.0)[0].s
    seen[lane] = [landmark.id for landmark in place.get_landmarks(60.0)]
    print(f"lane {lane}: drives from s = {start:g} to {ahead:g}, sees signals {seen[lane]}")
    assert (ahead > start) == (lane < 0)
sys.exit(seen != {-1: [], 1: ["7"]})
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
