"""Writes a network as a policy's file, which `ego=policy_file` drives by."""

import io
import logging
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import nn

from e2rl.planners.policy_file import ONNX, TORCHSCRIPT
from e2rl.run.config import library
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.sim.observation import OBSERVATION_SIZE

EXAMPLE = 2  # observations that the network is traced with


def write_policy(policy: nn.Module, file: Path) -> None:
    """Write a module whose `forward(observation)` maps [B, OBSERVATION_SIZE] to actions [B, 2] (m/s^2, rad/s) as ONNX
    or TorchScript, told by the suffix; raises InputError for another one."""
    writers: dict[str, Callable[[nn.Module, Path], None]] = {ONNX: _write_onnx, TORCHSCRIPT: _write_torchscript}
    if file.suffix not in writers:
        raise InputError(f"{file}: no kind of policy; name it {ONNX}, or {TORCHSCRIPT} for TorchScript")
    write_atomically(file, partial(writers[file.suffix], policy.eval()))


def _write_torchscript(policy: nn.Module, file: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        traced = torch.jit.trace(policy, torch.zeros(EXAMPLE, OBSERVATION_SIZE))
        buffer = io.BytesIO()
        torch.jit.save(traced, buffer)
    file.write_bytes(buffer.getvalue())


def _write_onnx(policy: nn.Module, file: Path) -> None:
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
