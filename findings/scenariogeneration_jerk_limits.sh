#!/usr/bin/env bash
# scenariogeneration reads an OpenSCENARIO file and writes it again without the jerk limits of a distance action.
#
# OpenSCENARIO 1.2 has maxAccelerationRate and maxDecelerationRate in DynamicConstraints. LongitudinalDistanceAction of the
# package takes and writes both, and its parse() reads neither, so a scenario that is read, changed and written loses them
# and a simulator lets the vehicle brake at any jerk. parse() of DynamicsConstraints, the same element, keeps them.
# Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q scenariogeneration==0.16.7
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

from scenariogeneration import xosc


def limits(element):
    return {name: value for part in element.iter() for name, value in part.attrib.items() if name.startswith("max")}


def both(thing):
    """The limits that are written, and those that are written after reading them back."""
    return limits(thing.get_element()), limits(type(thing).parse(thing.get_element()).get_element())


action = xosc.LongitudinalDistanceAction(
    "lead",
    max_acceleration=2,
    max_deceleration=3,
    max_speed=30,
    distance=20,
    max_acceleration_rate=1,
    max_deceleration_rate=4,
)
constraints = xosc.DynamicsConstraints(2, 3, 30, 1, 4)
print("scenariogeneration", version("scenariogeneration"))
lost, kept = both(action), both(constraints)
for name, (first, second) in (("LongitudinalDistanceAction", lost), ("DynamicsConstraints", kept)):
    print(name, "written:", first)
    print(name, "read and written again:", second)
rates = {"maxAccelerationRate", "maxDecelerationRate"}
sys.exit(not (set(lost[0]) - set(lost[1]) == rates and kept[0] == kept[1] and rates <= set(kept[1])))
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
