"""ego=policy_file: the policy of an ONNX or TorchScript file, by the observation (docs/observation.md).

An ONNX file holds arithmetic. A TorchScript file is a program, which may write files: run those that you trust.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from e2rl.planners.actor import ObservingEgo
from e2rl.planners.ego import finite
from e2rl.run.errors import InputError
from e2rl.run.settings import configured, setting
from e2rl.sim.observation import OBSERVATION_SIZE

ONNX, TORCHSCRIPT = ".onnx", ".pt"
MAPS = f"it maps float32 observations [B, {OBSERVATION_SIZE}] to actions [B, 2] for every B (docs/observation.md)"
PROBED = (1, 3)  # batches that a file is tried with


@configured("ego/policy_file")
@dataclass(eq=False)
class PolicyFileEgo(ObservingEgo):
    """Drives by the actions of a file, on the CPU; those beyond the bounds are clipped to them."""

    file: str | None = setting()
    max_acceleration: float = setting()
    max_braking: float = setting()
    max_yaw_rate: float = setting()

    def __post_init__(self) -> None:
        """Raises InputError where the file is none or maps other shapes."""
        if not self.file or not Path(self.file).is_file():
            raise InputError(
                f"ego.file={self.file}: no such file; pass POLICY{ONNX}, or POLICY{TORCHSCRIPT} of TorchScript"
            )
        self.low = torch.tensor([-self.max_braking, -self.max_yaw_rate])
        self.high = torch.tensor([self.max_acceleration, self.max_yaw_rate])
        self.policy = open_policy(Path(self.file))
        for count in PROBED:
            self._probe(f"ego.file={self.file}", count)

    def decide(self, observation: Tensor) -> Tensor:
        """The file's action [B, 2] at the observation; raises NotFinite where it is NaN or infinite."""
        action = finite(self.policy(observation.float().cpu()), "action")
        return torch.clamp(action, self.low, self.high).to(observation)

    def _probe(self, where: str, count: int) -> None:
        """InputError where the policy does not map observations of a batch of `count` to actions."""
        try:
            action = self.policy(torch.zeros(count, OBSERVATION_SIZE))
            fits = isinstance(action, Tensor) and action.is_floating_point() and action.shape == (count, 2)
            found = f"maps them to {action.dtype} {list(action.shape)}" if isinstance(action, Tensor) else type(action)
        except Exception as error:  # the file's own
            fits, found = False, " ".join(str(error).split())[-300:]
        if not fits:
            raise InputError(f"{where}: fails at observations [{count}, {OBSERVATION_SIZE}]: {found}; {MAPS}")


def open_policy(file: Path) -> Callable[[Tensor], Any]:
    """The function of a policy's file, told by the file's suffix."""
    if file.suffix == ONNX:
        return OnnxPolicy(file)
    if file.suffix == TORCHSCRIPT:
        return torchscript_policy(file)
    raise InputError(f"ego.file={file}: no kind of policy; pass {ONNX}, or {TORCHSCRIPT} for TorchScript")


def torchscript_policy(file: Path) -> Callable[[Tensor], Any]:
    """The module of a TorchScript archive."""
    try:
        module = torch.jit.load(str(file), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0][:200]
        raise InputError(f"ego.file={file}: no TorchScript archive ({reason}); write one by torch.jit.save") from error
    return torch.no_grad()(module)


class OnnxPolicy:
    """A session of onnxruntime with one thread, in each process its own."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._open()

    def _open(self) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            reason = f"onnxruntime cannot be imported ({error}); pip install 'e2rl[onnx]'"
            raise InputError(f"ego.file={self.file}: {reason}") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what fails is raised
        try:
            self.session = onnxruntime.InferenceSession(str(self.file), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's are of many kinds
            reason = " ".join(str(error).split())[:200]
            raise InputError(f"ego.file={self.file}: cannot be read as ONNX ({reason}); export it again") from error
        self.name, self._process = self.session.get_inputs()[0].name, os.getpid()

    def __call__(self, observation: Tensor) -> Any:
        if self._process != os.getpid():  # forked
            self._open()
        (action,) = self.session.run(None, {self.name: observation.numpy()})
        return torch.as_tensor(action)
