#!/usr/bin/env bash
# The XML writer of commonroad-io cuts numbers off instead of rounding, at the digits of the writer that was made last.
#
# `decimal_precision` is documented as the number of decimal places used when writing floats (4 by default). Places and
# speeds are cut towards zero: 13.89 m/s at one place is 13.8, and 1.99999 m at four is 1.9999, so every speed read back
# is too low or right, never too high. The precision is one value for the process: a writer made for ten places writes
# four as soon as another writer exists. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-io==2026.1
cd "$folder"
cat > program.py <<'PYTHON'
import sys
from importlib.metadata import version

import numpy
from commonroad.common.common_scenario import ScenarioID
from commonroad.common.file_reader import CommonRoadFileReader
from commonroad.common.file_writer import CommonRoadFileWriter, OverwriteExistingFile
from commonroad.common.util import FileFormat
from commonroad.geometry.obstacle_shapes.rect_obstacle_shape import RectObstacleShape
from commonroad.planning.planning_problem import PlanningProblemSet
from commonroad.scenario.lanelet import Lanelet, LaneletType
from commonroad.scenario.obstacle import ObstacleType, StaticObstacle
from commonroad.scenario.scenario import Scenario, Tag
from commonroad.scenario.state import InitialState

left = numpy.array([[0.0, 2.0], [50.0, 2.0]])
scenario = Scenario(0.1, ScenarioID.from_benchmark_id("DEU_Test-1_1_T-1", "2020a"))
scenario.add_objects(Lanelet(left, left - [0, 2], left - [0, 4], 1, lanelet_type={LaneletType.URBAN}))
state = InitialState(0, numpy.array([1.99999, -1.99999]), 0.0, 13.89, 0.0, 0.0, 0.0)
scenario.add_objects(StaticObstacle(2, ObstacleType.CAR, RectObstacleShape(4.0, 2.0), state))


def writer(places):
    about = {"author": "a", "affiliation": "b", "source": "c", "tags": {Tag.URBAN}}
    problems = PlanningProblemSet()
    return CommonRoadFileWriter(scenario, problems, **about, decimal_precision=places, file_format=FileFormat.XML)


def read(name, made):
    made.write_to_file(name, OverwriteExistingFile.ALWAYS)
    found = CommonRoadFileReader(name).open()[0].static_obstacles[0].initial_state
    return found.position.tolist(), found.velocity


print("commonroad-io", version("commonroad-io"), "written: [1.99999, -1.99999] m, 13.89 m/s")
one = read("one.xml", writer(1))
four = read("four.xml", writer(4))
ten = read("ten.xml", writer(10))
first = writer(10)
writer(4)
other = read("other.xml", first)
print("1 place:                            ", one)
print("4 places:                           ", four)
print("10 places:                          ", ten)
print("10 places, another writer has 4:    ", other)
cut = one == ([1.9, -1.9], 13.8) and four == ([1.9999, -1.9999], 13.89)
shared = ten == ([1.99999, -1.99999], 13.89) and other == four
sys.exit(not (cut and shared))
PYTHON
"$folder/venv/bin/python" program.py
