#!/usr/bin/env bash
# commonroad-io reads yaw rate and slip angle of an initial state as 0 where the file gives no acceleration.
#
# The schema that the package ships (2020a) makes velocity, yaw rate and slip angle of a planning problem's initial state
# mandatory and the acceleration optional. The XML reader fills the state in the order of its fields, stops at the first
# that is missing, and sets all that follow it to 0, without a warning: a planner that starts in a bend starts straight.
# Adding an acceleration to the same file brings the two numbers back. Exits 0 as long as that is so.
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
from lxml import etree

FILE = """<commonRoad timeStepSize="0.1" commonRoadVersion="2020a" author="a" affiliation="b" source="c"
    benchmarkID="DEU_Test-1_1_T-1" date="2026-01-01">
  <location><geoNameId>1</geoNameId><gpsLatitude>48</gpsLatitude><gpsLongitude>11</gpsLongitude></location>
  <scenarioTags><urban/></scenarioTags>
  <lanelet id="1">
    <leftBound><point><x>0</x><y>2</y></point><point><x>50</x><y>2</y></point></leftBound>
    <rightBound><point><x>0</x><y>-2</y></point><point><x>50</x><y>-2</y></point></rightBound>
    <laneletType>urban</laneletType>
  </lanelet>
  <planningProblem id="2">
    <initialState>
      <position><point><x>1</x><y>0</y></point></position>
      <velocity><exact>10</exact></velocity>
      <orientation><exact>0.1</exact></orientation>
      <yawRate><exact>0.3</exact></yawRate>
      <slipAngle><exact>0.05</exact></slipAngle>
      <time><exact>0</exact></time>{acceleration}
    </initialState>
    <goalState>
      <time><intervalStart>10</intervalStart><intervalEnd>20</intervalEnd></time>
      <position><lanelet ref="1"/></position>
    </goalState>
  </planningProblem>
</commonRoad>
"""


def read(acceleration):
    text = FILE.format(acceleration=acceleration)
    schema = os.path.join(os.path.dirname(commonroad.__file__), "common/xml_definition_files/XML_commonRoad_XSD.xsd")
    etree.XMLSchema(etree.parse(schema)).assertValid(etree.fromstring(text))
    with open("scenario.xml", "w") as file:
        file.write(text)
    _, problems = CommonRoadFileReader("scenario.xml").open()
    state = problems.planning_problem_dict[2].initial_state
    return state.yaw_rate, state.slip_angle


print("commonroad-io", version("commonroad-io"), "both files are valid by its schema and hold 0.3 rad/s and 0.05 rad")
without = read("")
given = read("<acceleration><exact>0</exact></acceleration>")
print("no acceleration: yaw rate and slip angle are", without)
print("acceleration 0:  yaw rate and slip angle are", given)
sys.exit(not (without == (0.0, 0.0) and given == (0.3, 0.05)))
PYTHON
"$folder/venv/bin/python" program.py
