"""`e2rl export-policy RUN_DIR POLICY.pt`: a trained actor as a policy's file.

It maps observations [B, 326] to the actor's most central actions [B, 2], with the
normalisation and the reference inside, and drives e2rl by `ego=policy_file
ego.file=POLICY.pt` (docs/guide/policies.md).
"""

import argparse
from pathlib import Path

from torch import Tensor, nn

from e2rl.planners.network import ActorNetwork, find_weights, read_actor
from e2rl.planners.policy_file import write_policy
from e2rl.run.endings import ending
from e2rl.run.errors import InputError


class Deterministic(nn.Module):
    """The most central action as a module."""

    def __init__(self, network: ActorNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor) -> Tensor:
        return self.network.deterministic(observation)


def export_actor(checkpoint: str, file: Path) -> None:
    """Write the actor that `find_weights` finds as TorchScript; raises InputError."""
    path = find_weights(checkpoint)
    actor = read_actor(path)
    if actor.architecture.evades:
        raise InputError(
            f"{path}: it evades by a planner, which sees more than the observation of a "
            "policy's file; drive with it by ego=actor ego.checkpoint, or train one with "
            "ego.evades=false"
        )
    write_policy(Deterministic(actor.network), file)


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl export-policy", description=__doc__)
    parser.add_argument(
        "actor",
        metavar="RUN_DIR",
        help="run of train.py, a checkpoint, an actor.safetensors; bundled",
    )
    parser.add_argument(
        "file",
        type=Path,
        metavar="POLICY.pt",
        help="to write, as TorchScript",
    )
    options = parser.parse_args(arguments)
    with ending():
        export_actor(options.actor, options.file)
        print(
            f"{options.file}: drive with it by ego=policy_file ego.file={options.file}"
        )
