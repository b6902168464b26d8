#!/usr/bin/env bash
# TorchRL's exploration never fades if it is to be annealed over 31 million frames; over 30 million it fades too fast.
#
# EGreedyModule, AdditiveGaussianModule and OrnsteinUhlenbeckProcessModule lower eps or sigma from its first to its last
# value in `annealing_num_steps` frames: step(frames) subtracts (first - last) / annealing_num_steps for each frame,
# from a number of single precision. Just below 1 such numbers lie 6e-8 apart. What is less than half of that is lost:
# with the default of 1 to 0.1 and 31 million frames eps stays 1, and a policy drives at random all the time, or with
# all of its noise. What is more than half is rounded up: with 20 million frames eps starts to fall 1.3 times as fast as
# asked for, with 30 million twice as fast. With 0.1 and 1 million it is right. Nothing is said. It matters to whoever
# trains in a fast simulator, where tens of millions of frames are an ordinary run. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import torch
from torchrl.data import Bounded, OneHot
from torchrl.modules import AdditiveGaussianModule, EGreedyModule, OrnsteinUhlenbeckProcessModule

MILLION = 1_000_000
FRAMES = 100_000
FIRST, LAST = 1.0, 0.1  # the defaults of all three

print("torchrl", version("torchrl"), "torch", torch.__version__)
box, choice = Bounded(-1.0, 1.0, (2,)), OneHot(4)
kinds = [
    ("EGreedyModule", EGreedyModule, choice, "eps"),
    ("AdditiveGaussianModule", AdditiveGaussianModule, box, "sigma"),
    ("OrnsteinUhlenbeckProcessModule", OrnsteinUhlenbeckProcessModule, box, "eps"),
]
rates = {0.1: 1.0, 1: 1.0, 20: 1.3, 30: 2.0, 31: 0.0, 50: 0.0}  # seen rate over the one asked for
good = True
for name, kind, spec, value in kinds:
    print(f"{name}: {value} after {FRAMES} frames")
    for millions, rate in rates.items():
        module = kind(spec=spec, annealing_num_steps=int(millions * MILLION))
        module.step(FRAMES)
        asked = (FIRST - LAST) * FRAMES / (millions * MILLION)
        seen = FIRST - getattr(module, value).item()
        print(f"  of {millions:g} million: {FIRST - seen:.6f}, asked for {FIRST - asked:.6f}, rate {seen / asked:.2f}")
        good &= seen == 0.0 if rate == 0.0 else abs(seen / asked - rate) < 0.05
sys.exit(0 if good else 1)
PYTHON
"$folder/venv/bin/python" -W ignore "$folder/program.py" 2> "$folder/log" || { cat "$folder/log"; exit 1; }
