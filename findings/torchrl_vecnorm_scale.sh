#!/usr/bin/env bash
# TorchRL's VecNormV2 divides a speed of 20 +- 1 m/s by 19 after 1000 steps, by 12 after 10,000, and not by 1.
#
# VecNormV2 keeps moving averages of x and x^2 that start at 0, and divides both by 1 - decay^n to make up for that
# start. The variance is mean(x^2) - mean(x)^2. The class takes the difference of the averages first and corrects it
# after, so the square of the mean is corrected once where it has to be twice. decay^n mean^2 is left in the variance.
# With the default decay of 0.9999 the speed has a spread of 0.05 after 1000 steps and 0.09 after 10,000 where 1 is
# right, and a policy hardly tells 18 m/s from 22. By the formula, which the scale follows here, it takes 75,518 steps
# to come within 10%. `scale`, to_observation_norm and a frozen_copy made at the end of a warm-up have the same number;
# the copy keeps it. The mean is right, and so are decay=1 and VecNorm, which VecNormV2 is to replace. It matters to
# whoever normalizes what is far from 0 against its spread, such as speeds and positions. Exits 0 as long as that is so.
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
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv, VecNorm, VecNormV2

MEAN, SPREAD = 20.0, 1.0  # m/s
DECAY = 0.9999  # the default


class Car(EnvBase):
    """A car whose speed is drawn anew at each step."""

    def __init__(self):
        super().__init__()
        self.observation_spec = Composite(speed=Unbounded((1,)))
        self.action_spec = Unbounded((1,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(done=Binary(1, dtype=torch.bool), terminated=Binary(1, dtype=torch.bool))
        self.generator = torch.Generator().manual_seed(0)

    def speed(self):
        return MEAN + SPREAD * torch.randn(1, generator=self.generator)

    def _reset(self, tensordict):
        return TensorDict(speed=self.speed())

    def _step(self, tensordict):
        end = torch.zeros(1, dtype=torch.bool)
        return TensorDict(speed=self.speed(), reward=torch.zeros(1), done=end, terminated=end.clone())

    def _set_seed(self, seed):
        pass


def made(kind, decay):
    return TransformedEnv(Car(), kind(in_keys=["speed"], out_keys=["normalized"], decay=decay))


def spread(env):
    return env.rollout(300)["next", "normalized"].std().item()


print("torchrl", version("torchrl"), "tensordict", version("tensordict"), "torch", torch.__version__)
print(f"a speed of {MEAN:g} +- {SPREAD:g} m/s; spread of 300 normalized speeds, 1 is right")
good = True
kinds = [("VecNormV2", VecNormV2, DECAY), ("VecNormV2", VecNormV2, 1.0), ("VecNorm", VecNorm, DECAY)]
for name, kind, decay in kinds:
    env = made(kind, decay)
    steps = 0
    for more in (1000, 9000):
        env.rollout(more)
        steps += more
        seen = spread(env)
        print(f"  {name}, decay {decay:g}, after {steps} steps: {seen:.3f}", end="")
        if (name, decay) == ("VecNormV2", DECAY):
            norm = env.transform
            scale, count = norm.scale["speed"].item(), norm._count["speed"].item()
            left = math.sqrt(SPREAD**2 + DECAY**count * MEAN**2)
            mean = norm.loc["speed"].item()
            print(f"; mean {mean:.2f}, scale {scale:.2f}, sqrt(1 + decay^{count} 20^2) = {left:.2f}")
            good &= abs(scale - left) < 0.03 * left and seen < 0.1
            good &= abs(mean - MEAN) < 0.2
        else:
            print()
            good &= 0.85 < seen < 1.15
        steps += 300
    if (name, decay) == ("VecNormV2", DECAY):
        frozen = TransformedEnv(Car(), norm.frozen_copy())
        for _ in range(3):
            seen = spread(frozen)
        print(f"  a frozen copy of it, 900 steps later: {seen:.3f}")
        copied = norm.to_observation_norm().scale.item()
        print(f"  scale of its to_observation_norm(): {copied:.2f}")
        good &= seen < 0.1 and abs(copied - norm.scale["speed"].item()) < 1e-3
needed = math.ceil(math.log(SPREAD**2 * (1.1**2 - 1) / MEAN**2) / math.log(DECAY))
print(f"by the formula the scale is within 10% from step {needed} on")
good &= needed == 75518
sys.exit(0 if good else 1)
PYTHON
"$folder/venv/bin/python" -W ignore "$folder/program.py" 2> "$folder/log" || { cat "$folder/log"; exit 1; }
