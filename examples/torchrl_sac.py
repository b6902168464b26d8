"""TorchRL's SAC in attacked traffic: `python examples/torchrl_sac.py [STEPS] [POLICY.onnx]` (extra onnx).

Half of the episodes are nominal, half attacked by e2 at an intensity of 1. An action lasts 0.2 s. Every episode's
return and end are in monitor.csv beside the policy.
"""

import csv
import sys
from pathlib import Path

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

import e2rl
from e2rl.planners.policy_export import write_policy
from e2rl.sim.observation import OBSERVATION_SIZE


class Actor(nn.Module):
    """Mean and spread of the action before squashing; a narrow spread at first, or it steers off the road at once."""

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.layers = MLP(OBSERVATION_SIZE, 4, num_cells=[128, 128], activation_class=nn.SiLU)
        self.spread = NormalParamExtractor(scale_mapping="biased_softplus_0.3")
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        return self.spread(self.layers(observation))
