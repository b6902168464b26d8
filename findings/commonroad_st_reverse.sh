#!/usr/bin/env bash
# The single-track model (ST) of commonroad-vehicle-models blows up as soon as a vehicle drives backwards.
#
# The parameters allow speeds down to v_min = -13.9 m/s. With a negative speed the tyres' side forces of the ST model push
# with the slip, not against it: from a yaw rate of 0.0001 rad/s and straight wheels at -5 m/s, half a second makes more
# than 1000 rad/s. At +5 m/s it dies away, and the drift model (STD) of the same package never exceeds its start.
# A trajectory that backs into a parking gap cannot be simulated with it. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q commonroad-vehicle-models==3.0.2 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import numpy
from vehiclemodels.init_std import init_std
from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st
from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std

vehicle = parameters_vehicle2()
STEP, STEPS, KICK = 1e-4, 5000, 1e-4


def yaw_rate(model, state):
    """That of the state half a second later, with no input, by Runge and Kutta's method."""
    state = numpy.array(state, dtype=float)

    def slope(at):
        return numpy.array(model(list(at), [0.0, 0.0], vehicle))

    for _ in range(STEPS):
        a = slope(state)
        b = slope(state + STEP / 2 * a)
        c = slope(state + STEP / 2 * b)
        d = slope(state + STEP * c)
        state = state + STEP / 6 * (a + 2 * b + 2 * c + d)
        if abs(state[5]) > 1e6:
            break
    return abs(state[5])


print("commonroad-vehicle-models", version("commonroad-vehicle-models"), "v_min", vehicle.longitudinal.v_min, "m/s")
found = {}
for speed in (5.0, -5.0):
    start = [0.0, 0.0, 0.0, speed, 0.0, KICK, 0.0]  # x, y, steering, speed, yaw, yaw rate, slip
    found[speed] = yaw_rate(vehicle_dynamics_st, start), yaw_rate(vehicle_dynamics_std, init_std(start, vehicle))
    print(f"{speed:+.0f} m/s: yaw rate from {KICK} rad/s, 0.5 s later: ST {found[speed][0]:.2g}, STD {found[speed][1]:.2g}")
assert vehicle.longitudinal.v_min < -5
sys.exit(not (found[-5.0][0] > 1000 and max(found[5.0] + found[-5.0][1:]) <= KICK))
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
