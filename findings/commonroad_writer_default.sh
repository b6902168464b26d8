#!/usr/bin/env bash
# CommonRoadFileWriter.write_to_file writes nothing and raises nothing, unless it is asked for XML.
#
# By its documentation the call writes a scenario and its planning problems to a file. Since the default format became
# protobuf the call reaches a method without a body: no file, no warning, nothing returned. A program that kept its call
# from the years when XML was the default loses what it made. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-io==2026.1
cd "$folder"
cat > program.py <<'PYTHON'
import sys
import warnings
from importlib.metadata import version
from pathlib import Path

import numpy
from commonroad.common.common_scenario import ScenarioID
from commonroad.common.file_writer import CommonRoadFileWriter, OverwriteExistingFile
from commonroad.common.util import FileFormat
from commonroad.planning.planning_problem import PlanningProblemSet
from commonroad.scenario.lanelet import Lanelet, LaneletType
from commonroad.scenario.scenario import Scenario, Tag

warnings.simplefilter("error")
left = numpy.array([[0.0, 2.0], [50.0, 2.0]])
scenario = Scenario(0.1, ScenarioID.from_benchmark_id("DEU_Test-1_1_T-1", "2020a"))
scenario.add_objects(Lanelet(left, left - [0, 2], left - [0, 4], 1, lanelet_type={LaneletType.URBAN}))
about = {"author": "a", "affiliation": "b", "source": "c", "tags": {Tag.URBAN}}
print("commonroad-io", version("commonroad-io"))
sizes = {}
for name, options in (("default", {}), ("xml", {"file_format": FileFormat.XML})):
    writer = CommonRoadFileWriter(scenario, PlanningProblemSet(), **about, **options)
    before = set(Path().rglob("*"))
    answer = writer.write_to_file(f"{name}.xml", OverwriteExistingFile.ALWAYS)
    made = sorted(str(path) for path in set(Path().rglob("*")) - before)
    sizes[name] = made
    print(f"write_to_file, {name}: returns {answer}, files made: {made}")
sys.exit(sizes != {"default": [], "xml": ["xml.xml"]})
PYTHON
"$folder/venv/bin/python" program.py
