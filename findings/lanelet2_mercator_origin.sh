#!/usr/bin/env bash
# lanelet2's MercatorProjector takes a scale from its origin, not the origin: a map lies 4000 km from where others put it.
#
# The origin of a projector is the place that becomes the local (0, 0), and UtmProjector and LocalCartesianProjector keep
# to it. MercatorProjector(origin) uses the cosine of the latitude as a scale, and counts from the equator and Greenwich:
# the origin itself is at (613 km, 4117 km). A map that is written with it and read by another lies in the sea, and a
# float32 of such a coordinate is good to 0.25 to 0.5 m. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q lanelet2==1.2.3 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import math
import sys
from importlib.metadata import version

import numpy
from lanelet2.core import BasicPoint3d, GPSPoint
from lanelet2.io import Origin
from lanelet2.projection import LocalCartesianProjector, MercatorProjector, UtmProjector

origin = (49.0, 8.4)
print("lanelet2", version("lanelet2"), "origin", origin)
places, back = {}, {}
for kind in (UtmProjector, LocalCartesianProjector, MercatorProjector):
    projector = kind(Origin(*origin))
    place = projector.forward(GPSPoint(*origin, 0.0))
    world = projector.reverse(BasicPoint3d(100.0, 0.0, 0.0))
    places[kind], back[kind] = (place.x, place.y), (world.lat, world.lon)
    print(f"{kind.__name__}: the origin is at ({place.x:.1f}, {place.y:.1f}) m,", end=" ")
    print(f"and (100, 0) m is at {world.lat:.4f} N, {world.lon:.4f} E")
print("spacing of float32 there:", numpy.spacing(numpy.float32(places[MercatorProjector][1])), "m")
near = all(math.hypot(*places[kind]) < 1e-3 for kind in (UtmProjector, LocalCartesianProjector))
far = math.hypot(*places[MercatorProjector]) > 4e6 and abs(back[MercatorProjector][0]) < 1e-6
sys.exit(not (near and far))
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
