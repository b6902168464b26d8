"""commonroad-sumo converts CommonRoad files: the lights of each, and the connections
that they hold."""

import json
import logging
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

from commonroad.common.file_reader import CommonRoadFileReader
from commonroad_sumo.cr2sumo import CR2SumoMapConverter

logging.disable(logging.CRITICAL)
for file in sys.argv[1:]:
    scenario, _ = CommonRoadFileReader(file).open()
    with tempfile.TemporaryDirectory() as folder:
        CR2SumoMapConverter(scenario).create_sumo_files(Path(folder))
        (path,) = Path(folder).rglob("*.net.xml")
        root = ElementTree.parse(path).getroot()
    connections = [
        each
        for each in root.iterfind("connection")
        if not each.get("from").startswith(":")
    ]
    found = {
        "connections": len(connections),
        "signalled": sum(each.get("tl") is not None for each in connections),
        "lights": len(root.findall("tlLogic")),
    }
    print("answer:", json.dumps(found))
