#!/usr/bin/env bash
# TorchRL prioritizes its replay by the square of the TD error for DQN and TD3, and by its amount for SAC.
#
# PrioritizedSampler is documented to sample with p^alpha, where p = |delta| + epsilon is the amount of the TD error, as
# in the paper that it cites, and advises an alpha of 0.4 to 0.7. The losses write the priority under the key
# "td_error". SACLoss writes |delta|. DQNLoss, DDPGLoss, TD3Loss, IQLLoss, CQLLoss and REDQLoss write delta^2, and their
# docstrings do not say so. So alpha counts twice: at alpha = 0.6 a crash with a TD error of 16 has 28 times the
# probability of a step with one of 1, and not 5 times, as if alpha were 1.2, beyond the "maximum prioritization" of 1.
# The same alpha is another one as soon as TD3 is exchanged for SAC. It matters to whoever learns from rare crashes with
# a prioritized buffer. The sampler itself is not run here: the probabilities are those of its documentation. Exits 0 as
# long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.data import Bounded, OneHot, PrioritizedSampler
from torchrl.modules import Actor, ProbabilisticActor, QValueActor, TanhNormal, ValueOperator
from torchrl.objectives import CQLLoss, DDPGLoss, DQNLoss, IQLLoss, REDQLoss, SACLoss, TD3Loss

ERRORS = [1.0, 16.0]  # a step, and a crash
ALPHA = 0.6
BOX = Bounded(-1.0, 1.0, (1,))


class Zero(nn.Module):
    """A critic that says 0."""

    def __init__(self, size=1):
        super().__init__()
        self.value = nn.Parameter(torch.zeros(size))

    def forward(self, *inputs):
        return self.value.expand(*inputs[0].shape[:-1], -1)


def critic():
    return ValueOperator(Zero(), in_keys=["observation", "action"])


def actor():
    return Actor(nn.Linear(1, 1), spec=BOX)


def stochastic():
    network = nn.Sequential(nn.Linear(1, 2), NormalParamExtractor())
    module = TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(module, in_keys=["loc", "scale"], distribution_class=TanhNormal, spec=BOX)


def batch(action):
    """Last steps of episodes. Every value is 0, so that the TD error is the reward."""
    count = len(ERRORS)
    end = torch.ones(count, 1, dtype=torch.bool)
    after = TensorDict(
        observation=torch.zeros(count, 1),
        reward=torch.tensor(ERRORS)[:, None],
        done=end,
        terminated=end.clone(),
        batch_size=count,
    )
    return TensorDict(observation=torch.zeros(count, 1), action=action, next=after, batch_size=count)


torch.manual_seed(0)
losses = [
    DQNLoss(QValueActor(Zero(3), in_keys=["observation"], spec=OneHot(3)), delay_value=True),
    DDPGLoss(actor(), critic()),
    TD3Loss(actor(), critic(), action_spec=BOX),
    IQLLoss(stochastic(), critic(), ValueOperator(Zero(), in_keys=["observation"])),
    CQLLoss(stochastic(), critic(), action_spec=BOX),
    REDQLoss(stochastic(), critic(), action_spec=BOX),
    SACLoss(stochastic(), critic(), action_spec=BOX),
]
print("torchrl", version("torchrl"), "tensordict", version("tensordict"))
documented = r"p_i = |\delta_i| + \epsilon" in PrioritizedSampler.__doc__
print("documentation of PrioritizedSampler has p_i = |delta_i| + epsilon:", documented)
wanted = (ERRORS[1] / ERRORS[0]) ** ALPHA
print(f"TD errors {ERRORS}; by the documentation the second is drawn {wanted:.1f} times as often at alpha = {ALPHA}")
good = documented
for loss in losses:
    name = type(loss).__name__
    loss.make_value_estimator(gamma=0.9)
    data = batch(torch.eye(3)[[0, 0]] if name == "DQNLoss" else torch.zeros(len(ERRORS), 1))
    loss(data)
    seen = data["td_error"].flatten().tolist()
    texts = f"{type(loss).__doc__} {type(loss).forward.__doc__}".lower()
    told = "square" in texts
    print(f"  {name}: td_error {seen}, drawn {(seen[1] / seen[0]) ** ALPHA:.1f} times as often; told: {told}")
    good &= not told and seen == (ERRORS if name == "SACLoss" else [error**2 for error in ERRORS])
sys.exit(0 if good else 1)
PYTHON
"$folder/venv/bin/python" -W ignore "$folder/program.py" > "$folder/out" 2> "$folder/log" || {
    cat "$folder/out" "$folder/log"
    exit 1
}
grep -v INFO "$folder/out"
