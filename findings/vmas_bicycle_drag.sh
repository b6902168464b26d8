#!/usr/bin/env bash
# A car of VMAS' kinematic bicycle model that is told to drive 5 m/s drives 4 m/s, and turns by 80% of its yaw rate.
#
# KinematicBicycle takes a speed and a steering angle, and is documented by the equations of the kinematic bicycle, which
# has no drag. It turns them into the force that makes up for the missing speed in one step, and the world then takes 25%
# of the speed before it applies that force: its default drag. So the speed is 5.00, 3.75, 4.06, 3.98, ... and stays at 4,
# and so is the yaw rate. The steering still gives the right radius, at the wrong pace. DiffDrive does likewise, and the
# driving scenario of the package, road_traffic, leaves the drag at its default. A policy that learns from it learns to ask
# for 1.25 times of its speed. With World(drag=0) both are exact. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q vmas==1.5.2 torch==2.13.0 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import math
import sys
from importlib.metadata import version

import torch
import vmas
from vmas.simulator.core import Agent, Box, World
from vmas.simulator.dynamics.diff_drive import DiffDrive
from vmas.simulator.dynamics.kinematic_bicycle import KinematicBicycle
from vmas.simulator.scenario import BaseScenario

SPEED, STEERING, YAW_RATE = 5.0, 0.1, 0.3  # m/s, rad, rad/s
AXLE = 1.4  # m from the centre to each axle
SECONDS = 10.0


class Road(BaseScenario):
    def make_world(self, batch_dim, device, model="", **world):
        result = World(batch_dim, device, dt=0.1, **world)
        if model == "bicycle":
            dynamics = KinematicBicycle(result, width=1.8, l_f=AXLE, l_r=AXLE, max_steering_angle=0.6)
            limits = [10.0, 0.6]
        else:
            dynamics, limits = DiffDrive(result), [10.0, 1.0]
        result.add_agent(Agent("car", shape=Box(4.0, 1.8), u_range=limits, u_multiplier=[1.0, 1.0], dynamics=dynamics))
        return result

    def reset_world_at(self, env_index=None):
        pass

    def observation(self, agent):
        return agent.state.pos

    def reward(self, agent):
        return torch.zeros(self.world.batch_dim)


def driven(action, **options):
    """The first four and the last speed [m/s], and the heading [rad], after some seconds of the same action."""
    env = vmas.make_env(Road(), num_envs=1, device="cpu", **options)
    env.reset()
    car = env.agents[0]
    speeds = []
    for _ in range(round(SECONDS / 0.1)):
        env.step([torch.tensor([action])])
        speeds.append(car.state.vel.norm().item())
    return speeds[:4] + speeds[-1:], car.state.rot.item()


slip = math.atan(math.tan(STEERING) / 2)
turn = {"bicycle": SPEED / (2 * AXLE) * math.cos(slip) * math.tan(STEERING) * SECONDS, "diff_drive": YAW_RATE * SECONDS}
print("vmas", version("vmas"), "torch", torch.__version__)
good = True
for model, second in (("bicycle", STEERING), ("diff_drive", YAW_RATE)):
    for name, options in (("default drag", {}), ("drag=0", {"drag": 0.0})):
        speeds, heading = driven([SPEED, second], model=model, **options)
        print(f"{model}, {name}: {SPEED} m/s asked for, seen {[round(speed, 2) for speed in speeds]};", end=" ")
        print(f"heading after {SECONDS:g} s: {turn[model]:.2f} rad by the equations, seen {heading:.2f}")
        share = 1.0 if options else 0.8
        good &= abs(speeds[-1] - share * SPEED) < 0.01 and abs(heading - share * turn[model]) < 0.01 * turn[model]
sys.exit(0 if good else 1)
PYTHON
"$folder/venv/bin/python" "$folder/program.py" 2> "$folder/log" || { cat "$folder/log"; exit 1; }
