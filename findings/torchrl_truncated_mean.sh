#!/usr/bin/env bash
# The deterministic action of TorchRL's TruncatedNormal lies outside of the limits that its samples keep to.
#
# The mean of a normal distribution that is truncated to [low, high] lies within them, whatever its loc. TorchRL computes it
# with a probability between the limits that is clamped at 1e-6, so where less than that is left, the mean is the loc itself:
# from about five scales beyond a limit on. The samples are clamped to the limits. A policy that learned to brake at the
# limit with a small scale trains at -8 m/s^2 and is evaluated, with ExplorationType.DETERMINISTIC, at -20 m/s^2. The
# log-probability of its own samples, on which PPO's ratio and its gradient rest, is wrong there as well: -1138 and not 5.3
# in the last case below. `mode` is right. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 numpy==2.4.6 scipy==1.17.1
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import torch
from scipy.stats import truncnorm
from tensordict import TensorDict
from tensordict.nn import InteractionType, ProbabilisticTensorDictModule, set_interaction_type
from torchrl.modules import TruncatedNormal

LOW, HIGH = -8.0, 4.0  # m/s^2
SCALE = 0.25

print("torchrl", version("torchrl"), "torch", torch.__version__)
torch.manual_seed(0)
policy = ProbabilisticTensorDictModule(
    in_keys=["loc", "scale"],
    out_keys=["action"],
    distribution_class=TruncatedNormal,
    distribution_kwargs={"low": LOW, "high": HIGH},
)
rows = []
for loc in (-7.0, -8.5, -9.0, -10.0, -20.0):
    parameters = TensorDict(loc=torch.tensor([loc]), scale=torch.tensor([SCALE]))
    with set_interaction_type(InteractionType.DETERMINISTIC):
        action = policy(parameters.clone())["action"].item()
    with set_interaction_type(InteractionType.RANDOM):
        samples = torch.stack([policy(parameters.clone())["action"] for _ in range(200)])
    distribution = TruncatedNormal(parameters["loc"], parameters["scale"], low=LOW, high=HIGH)
    truth = truncnorm((LOW - loc) / SCALE, (HIGH - loc) / SCALE, loc, SCALE)
    seen = distribution.log_prob(samples[0]).item()
    expected = truth.logpdf(samples[0].item() + 1e-6)
    rows.append((loc, action, samples.min().item(), samples.max().item(), seen, expected))
    print(
        f"loc {loc:g}: mean {truth.mean():.2f} (scipy), deterministic {action:.2f}, mode {distribution.mode.item():.2f}, "
        f"samples {samples.min():.2f} to {samples.max():.2f}, log-probability of one {seen:.1f}, {expected:.1f} (scipy)"
    )
within = [LOW <= action <= HIGH for _, action, *_ in rows]
sampled = all(LOW <= low and high <= HIGH for _, _, low, high, *_ in rows)
sys.exit(0 if within == [True, True, True, False, False] and sampled and rows[-1][4] < -1000 < 0 < rows[-1][5] else 1)
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
