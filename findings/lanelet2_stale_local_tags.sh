#!/usr/bin/env bash
# lanelet2 writes a map that it moved by 10 m with the local_x of before: Autoware's readers see it where it was.
#
# Autoware's maps say where a point is twice: by lat and lon, which lanelet2 reads, and by the tags local_x and local_y [m],
# which Autoware's local projector reads. lanelet2 keeps tags that it does not know as attributes of the point, beside x
# and y. A map that is loaded, moved by 10 m and written has the new lat and lon, and the old local_x: of one file two
# readers make two maps. Of ele, the third tag, lanelet2 writes the new value. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q lanelet2==1.2.3
cat > "$folder/map.osm" <<'XML'
<osm>
  <node id="1" lat="35.0" lon="139.0">
    <tag k="local_x" v="1000.0"/><tag k="local_y" v="2000.0"/><tag k="ele" v="5.0"/></node>
  <node id="2" lat="35.0" lon="139.001">
    <tag k="local_x" v="1091.3"/><tag k="local_y" v="2000.0"/><tag k="ele" v="5.0"/></node>
  <way id="3"><nd ref="1"/><nd ref="2"/><tag k="type" v="line_thin"/></way>
</osm>
XML
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version
from xml.etree import ElementTree

from lanelet2.io import Origin, load, write
from lanelet2.projection import UtmProjector

before, after = sys.argv[1:]
projector = UtmProjector(Origin(35.0, 139.0))
print("lanelet2", version("lanelet2"))
lanelet_map = load(before, projector)
for point in lanelet_map.pointLayer:
    point.x += 10.0
    point.z += 1.0
write(after, lanelet_map, projector)


def places(path):
    """By node x by its lon, x by its local_x, and its height."""
    x = {point.id: point.x for point in load(path, projector).pointLayer}
    result = {}
    for node in ElementTree.parse(path).getroot().iter("node"):
        tags = {tag.get("k"): float(tag.get("v")) for tag in node}
        result[node.get("id")] = x[int(node.get("id"))], tags["local_x"], tags["ele"]
    return result


first, second = places(before), places(after)
moved = [[b - a for a, b in zip(first[node], second[node])] for node in first]
for node, (by_lon, by_tag, height) in zip(first, moved):
    print(f"node {node} moved by {by_lon:.2f} m by lon, {by_tag:.2f} m by local_x, {height:.2f} m by ele")
stale = all(abs(by_lon - 10) < 0.01 and by_tag == 0 and height == 1 for by_lon, by_tag, height in moved)
sys.exit(not stale)
PYTHON
"$folder/venv/bin/python" "$folder/program.py" "$folder/map.osm" "$folder/moved.osm"
