#!/usr/bin/env bash
# CommonRoad's scenario designer turns a sign of 30 mph into 30 m/s, and drops a lane's limit that is given in m/s.
#
# OpenDRIVE gives speed limits by the road's type, by its lanes and by signs, in km/h, mph or m/s, and m/s is meant
# where a limit of a road or lane has no unit. The converter of crdesigner reads each in its own way. A sign's value in
# mph is taken as m/s: 30 mph become 67 mph. A lane's limit in m/s, or without a unit, makes no sign: the lane has no
# limit, or that of the road where there is one. A road's 50 km/h are 13.85 m/s (by 0.277), so who drives 50 is too
# fast. Where the limit of a lane or a road changes at s = 50 m, the first one holds to the end: a zone of 36 km/h
# behind a stretch of 90 km/h has 90 km/h. There is no warning. Lanes in km/h and mph, roads in m/s, and signs in km/h
# and m/s are right. It matters to whoever rates planners by speed limits on maps of the format. Exits 0 as long as that
# is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-scenario-designer==0.8.5 commonroad-io==2024.3 commonroad-clcs==2025.2.0 \
  commonroad-drivability-checker==2025.4.0 commonroad-sumo==2025.1.4 numpy==2.4.6
cd "$folder"
cat > program.py <<'PYTHON'
import pathlib
import sys
from importlib.metadata import version

from crdesigner.map_conversion.map_conversion_interface import opendrive_to_commonroad

ROAD = """<?xml version="1.0"?>
<OpenDRIVE><header revMajor="1" revMinor="6" name="road" version="1" north="10" south="-10" east="100" west="0"/>
<road name="" length="100" id="1" junction="-1" rule="RHT">{}
<planView><geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry></planView>
<lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center>
<right><lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/>{}</lane></right>
</laneSection></lanes><signals>{}</signals></road></OpenDRIVE>
"""


def limit(road="", lane="", sign=""):
    pathlib.Path("road.xodr").write_text(ROAD.format(road or '<type s="0" type="town"/>', lane, sign))
    network = opendrive_to_commonroad(pathlib.Path("road.xodr")).lanelet_network
    (lanelet,) = network.lanelets
    signs = [network.find_traffic_sign_by_id(number) for number in lanelet.traffic_signs]
    values = [float(element.additional_values[0]) for sign in signs for element in sign.traffic_sign_elements]
    return min(values, default=None)


def unit(text):
    return f' unit="{text}"' if text else ""


def of_road(value, text, s=0):
    return f'<type s="{s}" type="town"><speed max="{value}"{unit(text)}/></type>'


def of_lane(value, text, s=0):
    return f'<speed sOffset="{s}" max="{value}"{unit(text)}/>'


def of_sign(value, text, country="USA", kind="R2-1", subtype="-1"):
    return (f'<signal s="20" t="-5" id="7" name="" dynamic="no" orientation="+" zOffset="2" country="{country}" '
            f'type="{kind}" subtype="{subtype}" value="{value}" unit="{text}" height="1" width="1"/>')


print("commonroad-scenario-designer", version("commonroad-scenario-designer"), "- lowest limit of the lanelet in m/s")
fifty, thirty = 50 / 3.6, 30 * 0.44704
same = True
for name, arguments, expected, seen in (
    ("road, 13.89 m/s", {"road": of_road(13.89, "m/s")}, 13.89, 13.89),
    ("road, 13.89 without unit", {"road": of_road(13.89, "")}, 13.89, 13.89),
    ("road, 30 mph", {"road": of_road(30, "mph")}, thirty, 13.41),
    ("road, 50 km/h", {"road": of_road(50, "km/h")}, fifty, 13.85),
    ("lane, 50 km/h", {"lane": of_lane(50, "km/h")}, fifty, fifty),
    ("lane, 30 mph", {"lane": of_lane(30, "mph")}, thirty, thirty),
    ("lane, 13.89 m/s", {"lane": of_lane(13.89, "m/s")}, 13.89, None),
    ("lane, 13.89 without unit", {"lane": of_lane(13.89, "")}, 13.89, None),
    ("lane, 5 m/s on a road of 30 m/s", {"road": of_road(30, "m/s"), "lane": of_lane(5, "m/s")}, 5.0, 30.0),
    ("lane, 18 km/h on a road of 30 m/s", {"road": of_road(30, "m/s"), "lane": of_lane(18, "km/h")}, 5.0, 5.0),
    ("sign of Germany, 50 km/h", {"sign": of_sign(50, "km/h", "DEU", "274", "50")}, fifty, fifty),
    ("sign of the USA, 13.89 m/s", {"sign": of_sign(13.89, "m/s")}, 13.89, 13.89),
    ("sign of the USA, 30 mph", {"sign": of_sign(30, "mph")}, thirty, 30.0),
    ("lane, 90 km/h, 36 km/h from 50 m", {"lane": of_lane(90, "km/h") + of_lane(36, "km/h", 50)}, 10.0, 25.0),
    ("road, 27 m/s, 8 m/s from 50 m", {"road": of_road(27, "m/s") + of_road(8, "m/s", 50)}, 8.0, 27.0),
):
    found = limit(**arguments)
    print(f"{name:33}: {'none' if found is None else format(found, '.2f'):>5} ({expected:.2f} is expected)")
    same = same and (found is None if seen is None else found is not None and abs(found - seen) < 0.002)
sys.exit(not same)
PYTHON
venv/bin/python -W ignore program.py 2> errors || { cat errors; exit 1; }
