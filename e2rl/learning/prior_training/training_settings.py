"""The settings of `prior.training`."""

from dataclasses import dataclass

from e2rl.run.errors import InputError
from e2rl.run.settings import check_range


@dataclass(frozen=True)
class TrainingSettings:
    """Fields: conf/prior/default.yaml; seed: the run's. Raises InputError for a value out of range."""

    starts: tuple[int, ...] = (10, 20, 30, 40, 50)
    steps: int = 1500
    batch: int = 32
    levels: int = 4
    learning_rate: float = 1e-3
    weight_decay: float = 0.1
    ema: float = 0.998
    trajectory: float = 0.15
    drop: float = 0.1
    feature_noise: float = 0.1
    accel_noise: float = 0.35
    mirror: float = 0.5
    causal: float = 0.4
    bf16: bool | None = None
    compile: bool = False
    route_steps: int = 600
    validate_every: int = 250
    closed_loop_every: int = 2
    closed_loop_scenes: int = 24
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "levels", "validate_every", "closed_loop_scenes"):
            check_range(f"prior.training.{name}", getattr(self, name), low=1)
        for name in ("learning_rate", "weight_decay", "trajectory", "feature_noise", "accel_noise"):
            check_range(f"prior.training.{name}", getattr(self, name), low=0)
        for name in ("ema", "drop", "mirror", "causal"):
            check_range(f"prior.training.{name}", getattr(self, name), low=0, high=1)
        if not self.starts or min(self.starts) < 0:
            raise InputError(f"prior.training.starts={list(self.starts)}: expected frame numbers, e.g. [10,30,50]")
        object.__setattr__(self, "starts", tuple(sorted(set(self.starts))))
