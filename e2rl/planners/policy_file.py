"""ego=policy_file: the policy of a TorchScript file, by the observation
(docs/guide/policies.md).

Such a file is a program, which may write files: run those that you trust.
"""

import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from e2rl.planners.actor import ObservingEgo
from e2rl.planners.plausibility import finite
from e2rl.run.config import configured, setting
from e2rl.run.errors import InputError
from e2rl.run.files import check_format, read_regular, write_atomically
from e2rl.sim.observation import OBSERVATION_SIZE

SUFFIX = ".pt"
FORMAT = "e2rl-policy/1"  # of observations and actions
FORMAT_ENTRY = "format"  # of a file of ours; those of others have none
MAPS = (
    f"it maps float32 observations [B, {OBSERVATION_SIZE}] to actions [B, 2] for every B "
    "(docs/guide/policies.md)"
)
PROBED = (1, 3)  # batches that a file is tried with
MAX_FILE = 1 << 26  # bytes: 16 million weights
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
        """Raises InputError where the file is none or maps other shapes."""
        self.low = torch.tensor([-self.max_braking, -self.max_yaw_rate])
        self.high = torch.tensor([self.max_acceleration, self.max_yaw_rate])
        self.policy = open_policy(Path(self.file or ""), f"ego.file={self.file}")

    def decide(self, observation: Tensor) -> Tensor:
        """The file's action [B, 2] at the observation; raises NotFinite where it is NaN
        or infinite."""
        action = finite(self.policy(observation.float().cpu().clone()), "action")
        return torch.clamp(action, self.low, self.high).to(observation)


def open_policy(file: Path, where: str) -> Callable[[Tensor], Any]:
    """Returns the function of a policy's file, tried; raises InputError."""
    try:
        content = read_regular(file, MAX_FILE)
    except OSError as error:
        raise InputError(
            f"{where}: cannot be read ({error.strerror}); pass a file of a policy"
        ) from error
    entries: dict[str, Any] = {FORMAT_ENTRY: b""}
    try:
        module = torch.jit.load(
            io.BytesIO(content), map_location="cpu", _extra_files=entries
        ).eval()
    except (RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0][:200]
        raise InputError(
            f"{where}: no TorchScript archive ({reason}); write one by "
            "e2rl.save_policy or torch.jit.save"
        ) from error
    if written := entries[FORMAT_ENTRY].decode(errors="replace"):
        mend = "write it again by e2rl.save_policy"
        check_format(file, written, expected=FORMAT, mend=mend)
    policy = torch.no_grad()(module)
    for count in PROBED:
        probe(policy, where, count=count)
    return policy


def probe(
    policy: Callable[[Tensor], Any],
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


def write_policy(policy: nn.Module, file: Path) -> None:
    """Writes a module of such a map, whose argument is `observation`; raises InputError
    where the file has another suffix."""
    if file.suffix != SUFFIX:
        raise InputError(f"{file}: name the policy's file POLICY{SUFFIX}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        traced = torch.jit.trace(policy.eval(), torch.zeros(EXAMPLE, OBSERVATION_SIZE))
        entries = {FORMAT_ENTRY: FORMAT}
        write_atomically(file, partial(torch.jit.save, traced, _extra_files=entries))
