"""`e2rl export-policy RUN_DIR POLICY.onnx|POLICY.pt`: a trained actor as a policy's file.

It maps observations [B, 326] to the actor's most central actions [B, 2], with the normalisation and the reference
inside, and drives e2rl by `ego=policy_file ego.file=POLICY.onnx` (docs/observation.md).
"""

import argparse
import io
import logging
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from e2rl.planners.network import ActorNetwork, find_weights, read_actor
from e2rl.planners.policy_file import ONNX, TORCHSCRIPT
from e2rl.run.config import library
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.sim.observation import OBSERVATION_SIZE

EXAMPLE = 2  # observations that the network is traced with


class Deterministic(nn.Module):
    """The most central action as a module."""

    def __init__(self, network: ActorNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor) -> Tensor:
        return self.network.deterministic(observation)


def export_actor(checkpoint: str, file: Path) -> None:
    """Write the actor that `find_weights` finds as ONNX or TorchScript, told by the suffix; raises InputError."""
    writers: dict[str, Callable[[Deterministic, Path], None]] = {ONNX: _write_onnx, TORCHSCRIPT: _write_torchscript}
    if file.suffix not in writers:
        raise InputError(f"{file}: no kind of policy; name it {ONNX}, or {TORCHSCRIPT} for TorchScript")
    policy = Deterministic(read_actor(find_weights(checkpoint)).network).eval()
    write_atomically(file, partial(writers[file.suffix], policy))


def _write_torchscript(policy: Deterministic, file: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        traced = torch.jit.trace(policy, torch.zeros(EXAMPLE, OBSERVATION_SIZE))
        buffer = io.BytesIO()
        torch.jit.save(traced, buffer)
    file.write_bytes(buffer.getvalue())


def _write_onnx(policy: Deterministic, file: Path) -> None:
    library("onnxscript", str(file), "onnx")
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it tells which packages it does without
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            policy,
            (torch.zeros(EXAMPLE, OBSERVATION_SIZE),),
            input_names=["observation"],
            output_names=["action"],
            dynamic_shapes={"observation": {0: torch.export.Dim("batch")}},
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    file.write_bytes(program.model_proto.SerializeToString())


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl export-policy", description=__doc__)
    parser.add_argument("actor", metavar="RUN_DIR", help="run of train.py, a checkpoint, an actor.safetensors; bundled")
    parser.add_argument("file", type=Path, metavar="FILE", help=f"to write: {ONNX}, or {TORCHSCRIPT} for TorchScript")
    options = parser.parse_args(arguments)
    with ending():
        export_actor(options.actor, options.file)
        print(f"{options.file}: drive with it by ego=policy_file ego.file={options.file}")
