#!/usr/bin/env bash
# A CommonRoad file that commonroad-io reads and writes again has lost its pedestrian crossings, horns and virtual signs.
#
# The file is valid by the schema that the package ships (2020a), and so is what is written. The reader takes the flag
# `virtual` of a traffic sign for an attribute, though the schema has it as an element, and so a virtual sign stands on the
# road. The writer has nothing for the crossing of an intersection and nothing for the horn among a vehicle's signals.
# There is no warning that any of it is gone. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-io==2026.1
cd "$folder"
cat > program.py <<'PYTHON'
import os
import sys
from importlib.metadata import version

import commonroad
from commonroad.common.file_reader import CommonRoadFileReader
from commonroad.common.file_writer import CommonRoadFileWriter, OverwriteExistingFile
from commonroad.common.util import FileFormat
from lxml import etree


def lanelet(number, x, rest):
    left, right = (
        "".join(f"<point><x>{end}</x><y>{y}</y></point>" for end in (x, x + 40)) for y in (2, -2)
    )
    return f'<lanelet id="{number}"><leftBound>{left}</leftBound><rightBound>{right}</rightBound>{rest}</lanelet>'


PLACE = "<position><point><x>5</x><y>{}</y></point></position>"
STATE = PLACE.format(0) + "<orientation><exact>0</exact></orientation>"
FILE = f"""<commonRoad timeStepSize="0.1" commonRoadVersion="2020a" author="a" affiliation="b" source="c"
    benchmarkID="DEU_Test-1_1_T-1" date="2026-01-01">
  <location><geoNameId>1</geoNameId><gpsLatitude>48</gpsLatitude><gpsLongitude>11</gpsLongitude></location>
  <scenarioTags><urban/></scenarioTags>
  {lanelet(1, 0, '<successor ref="2"/><laneletType>urban</laneletType><trafficSignRef ref="50"/>')}
  {lanelet(2, 40, '<predecessor ref="1"/><laneletType>urban</laneletType>')}
  {lanelet(3, 40, "<laneletType>crosswalk</laneletType>")}
  <trafficSign id="50">
    <trafficSignElement><trafficSignID>274</trafficSignID><additionalValue>13.89</additionalValue></trafficSignElement>
    {PLACE.format(-3)}<virtual>true</virtual>
  </trafficSign>
  <intersection id="60">
    <incoming id="61"><incomingLanelet ref="1"/><successorsStraight ref="2"/></incoming>
    <crossing><crossingLanelet ref="3"/></crossing>
  </intersection>
  <dynamicObstacle id="7"><type>car</type><shape><rectangle><length>4</length><width>2</width></rectangle></shape>
    <initialState>{STATE}<time><exact>0</exact></time><velocity><exact>9</exact></velocity></initialState>
    <initialSignalState><time><exact>0</exact></time><horn>true</horn><brakingLights>true</brakingLights></initialSignalState>
    <trajectory><state>{STATE}<time><exact>1</exact></time><velocity><exact>9</exact></velocity></state></trajectory>
  </dynamicObstacle>
  <planningProblem id="8">
    <initialState>{STATE}<time><exact>0</exact></time><velocity><exact>9</exact></velocity>
      <yawRate><exact>0</exact></yawRate><slipAngle><exact>0</exact></slipAngle></initialState>
    <goalState><time><intervalStart>10</intervalStart><intervalEnd>20</intervalEnd></time></goalState>
  </planningProblem>
</commonRoad>
"""


def read(name):
    schema = os.path.join(os.path.dirname(commonroad.__file__), "common/xml_definition_files/XML_commonRoad_XSD.xsd")
    etree.XMLSchema(etree.parse(schema)).assertValid(etree.parse(name))
    return CommonRoadFileReader(name).open()


def fields(scenario):
    network, signals = scenario.lanelet_network, scenario.dynamic_obstacles[0].initial_signal_state
    return {
        "virtual": network.traffic_signs[0].virtual,
        "crossings": [sorted(group.crossing_lanelets) for group in network.intersections[0].crossings],
        "horn": getattr(signals, "horn", None),
        "braking lights": getattr(signals, "braking_lights", None),
    }


with open("given.xml", "w") as file:
    file.write(FILE)
scenario, problems = read("given.xml")
CommonRoadFileWriter(scenario, problems, file_format=FileFormat.XML).write_to_file("written.xml", OverwriteExistingFile.ALWAYS)
first, second = fields(scenario), fields(read("written.xml")[0])
print("commonroad-io", version("commonroad-io"))
print("given:   {'virtual': True, 'crossings': [[3]], 'horn': True, 'braking lights': True}")
print("read:   ", first)
print("written:", second)
was = {"virtual": False, "crossings": [[3]], "horn": True, "braking lights": True}
sys.exit(not (first == was and second == {"virtual": False, "crossings": [], "horn": None, "braking lights": True}))
PYTHON
"$folder/venv/bin/python" program.py
