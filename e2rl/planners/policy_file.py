"""ego=policy_file: the policy of an ONNX or TorchScript file, by the observation
(docs/guide/policies.md).

An ONNX file holds arithmetic. A TorchScript file is a program, which may write files:
run those that you trust.
"""

import io
import logging
import warnings
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

import torch
from torch import Tensor, nn

from e2rl.planners.actor import ObservingEgo
from e2rl.planners.onnx_policy import OnnxPolicy
from e2rl.planners.plausibility import finite
from e2rl.run.config import library
from e2rl.run.errors import InputError
from e2rl.run.files import read_regular, write_atomically
from e2rl.run.settings import configured, setting
from e2rl.sim.observation import OBSERVATION_SIZE

ONNX = ".onnx"
TORCHSCRIPT = ".pt"
MAPS = (
    f"it maps float32 observations [B, {OBSERVATION_SIZE}] to actions [B, 2] for every B "
    "(docs/guide/policies.md)"
)
Policy = Callable[[Tensor], Any]
PROBED = (1, 3)  # batches that a file is tried with
MAX_FILE = 1 << 26  # bytes: 16 million weights
SECONDS = 20.0  # to open and try a file
EXAMPLE = 2  # observations that a network is traced with


@configured("ego/policy_file")
@dataclass(eq=False)
class PolicyFileEgo(ObservingEgo):
    """Drives by the actions of a file, on the CPU; those beyond the bounds are clipped
    to them."""

    file: str | None = setting()
    max_acceleration: float = setting()
    max_braking: float = setting()
    max_yaw_rate: float = setting()

    def __post_init__(self) -> None:
        """Raises InputError where the file is none, maps other shapes, or takes longer
        than SECONDS to find out."""
        self.low = torch.tensor([-self.max_braking, -self.max_yaw_rate])
        self.high = torch.tensor([self.max_acceleration, self.max_yaw_rate])
        where = f"ego.file={self.file}"
        self.policy = within_time(
            partial(open_policy, Path(self.file or ""), where), where
        )

    def decide(self, observation: Tensor) -> Tensor:
        """The file's action [B, 2] at the observation; raises NotFinite where it is NaN
        or infinite."""
        action = finite(self.policy(observation.float().cpu().clone()), "action")
        return torch.clamp(action, self.low, self.high).to(observation)


def within_time(work: Callable[[], Any], where: str) -> Any:
    """What work() returns or raises; raises InputError where it goes on for longer than
    SECONDS."""
    result: Future = Future()

    def run() -> None:
        try:
            result.set_result(work())
        except BaseException as error:
            result.set_exception(error)

    Thread(target=run, daemon=True).start()  # what does not end is left behind
    if wait([result], SECONDS).not_done:
        raise InputError(
            f"{where}: opening it takes longer than {SECONDS} s; give a smaller policy"
        )
    return result.result()


def probe(
    policy: Policy,
    where: str,
    count: int,
) -> None:
    """Raises InputError where a policy does not map observations of a batch of `count`
    to actions."""
    try:
        action = policy(torch.zeros(count, OBSERVATION_SIZE))
        if not isinstance(action, Tensor):
            raise TypeError(f"returns {type(action)}")
        if not action.is_floating_point() or action.shape != (count, 2):
            raise TypeError(f"maps them to {action.dtype} {list(action.shape)}")
    except Exception as error:  # the file's own
        reason = " ".join(str(error).split())[-300:]
        raise InputError(
            f"{where}: fails at observations [{count}, {OBSERVATION_SIZE}]: {reason}; "
            f"{MAPS}"
        ) from error


def open_policy(file: Path, where: str) -> Policy:
    """The function of a policy's file, told by the file's suffix and tried."""
    kinds: dict[str, Callable[[bytes, str], Policy]] = {
        ONNX: OnnxPolicy,
        TORCHSCRIPT: torchscript_policy,
    }
    if file.suffix not in kinds:
        raise InputError(
            f"{where}: no kind of policy; pass POLICY{ONNX}, or POLICY{TORCHSCRIPT} of "
            "TorchScript"
        )
    try:
        content = read_regular(file, MAX_FILE)
    except OSError as error:
        raise InputError(
            f"{where}: cannot be read ({error.strerror}); pass a file of a policy"
        ) from error
    policy = kinds[file.suffix](content, where)
    for count in PROBED:
        probe(policy, where, count=count)
    return policy


def torchscript_policy(content: bytes, where: str) -> Policy:
    """The module of a TorchScript archive."""
    try:
        module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0][:200]
        raise InputError(
            f"{where}: no TorchScript archive ({reason}); write one by torch.jit.save"
        ) from error
    return torch.no_grad()(module)


def write_policy(policy: nn.Module, file: Path) -> None:
    """Write a module of such a map, whose argument is `observation`, as the suffix
    says; raises InputError."""
    writers = {ONNX: _write_onnx, TORCHSCRIPT: _write_torchscript}
    if file.suffix not in writers:
        raise InputError(
            f"{file}: no kind of policy; name it {ONNX}, or {TORCHSCRIPT} for TorchScript"
        )
    if file.suffix == ONNX:
        library(
            "onnxscript",
            str(file),
            extra="onnx",
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write_atomically(file, partial(writers[file.suffix], policy.eval()))


def _write_torchscript(policy: nn.Module, file: Path) -> None:
    traced = torch.jit.trace(policy, torch.zeros(EXAMPLE, OBSERVATION_SIZE))
    torch.jit.save(traced, file)


def _write_onnx(policy: nn.Module, file: Path) -> None:
    # It tells which packages it does without.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
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
