#!/usr/bin/env bash
# TorchRL's TanhNormal with tanh_loc=True brakes at full force where the policy asks for the middle of the range.
#
# The documentation has loc = tanh(loc / upscale) * upscale for tanh_loc=True, so a loc of 0 stays 0, and is the middle of
# `low` and `high` after the tanh. If the limits are not -1 and 1, the class also adds the middle of the limits to loc,
# before the tanh, and the mapping to the limits adds it once more, behind the tanh. For an acceleration from -8 to 4 m/s^2
# a loc of 0 gives -7.8 and not -2, and for a speed from 0 to 30 m/s it gives 30.0 and not 15, where the tanh has no
# gradient left. Limits that are symmetric about 0 do not show it. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import math
import sys
from importlib.metadata import version

import torch
from torchrl.modules import TanhNormal

UPSCALE = 5.0


def documented(loc, low, high):
    """The action at the middle of the normal distribution, by the documentation of tanh_loc."""
    return (low + high) / 2 + (high - low) / 2 * math.tanh(math.tanh(loc / UPSCALE) * UPSCALE)


def distribution(loc, low, high, tanh_loc):
    return TanhNormal(torch.tensor([loc]), torch.tensor([0.1]), upscale=UPSCALE, low=low, high=high, tanh_loc=tanh_loc)


print("torchrl", version("torchrl"), "torch", torch.__version__)
torch.manual_seed(0)
wrong = []
for low, high in ((-1.0, 1.0), (-4.0, 4.0), (-8.0, 4.0), (0.0, 30.0)):
    for loc in (0.0, 0.5):
        plain = distribution(loc, low, high, False).deterministic_sample.item()
        scaled = distribution(loc, low, high, True)
        action, mean = scaled.deterministic_sample.item(), scaled.sample((1000,)).mean().item()
        expected = documented(loc, low, high)
        print(f"[{low:g}, {high:g}], loc {loc}: {plain:.2f} without tanh_loc; with it {expected:.2f} expected, {action:.2f} seen, {mean:.2f} the mean of samples")
        if abs(action - expected) > 0.5 and abs(mean - expected) > 0.5:
            wrong.append((low, loc))
sys.exit(0 if wrong == [(-8.0, 0.0), (-8.0, 0.5), (0.0, 0.0), (0.0, 0.5)] else 1)
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
