"""The settings of `prior.training`, checked: a wrong kind or an impossible size is the user's to mend."""

import math
from dataclasses import dataclass, fields

from e2rl.errors import InputError

AT_LEAST = {
    "steps": 1,
    "batch": 1,
    "levels": 1,
    "validate_every": 1,
    "closed_loop_scenes": 1,
    "learning_rate": 0.0,
    "weight_decay": 0.0,
    "ema": 0.0,
    "trajectory": 0.0,
    "drop": 0.0,
    "feature_noise": 0.0,
    "accel_noise": 0.0,
    "mirror": 0.0,
    "causal": 0.0,
    "route_steps": 0,
    "closed_loop_every": 0,
}
AT_MOST = {"ema": 1.0, "drop": 1.0, "mirror": 1.0, "causal": 1.0}


@dataclass(frozen=True)
class TrainingSettings:
    """Start frames of the scenes cut from each log; optimisation steps; windows a step, over all processes together,
    and noise levels a window; peak learning rate; weight decay; EMA decay; weight of the trajectory term; share of
    other vehicles hidden; feature noise [standard deviations]; noise on the current acceleration [m/s^2]; share of
    windows that are mirrored, and of those whose start states are a causal observer's estimates; bf16 autocast;
    torch.compile; route-choice steps; steps between validations; validations between closed loops (0: none) and their
    scenes; seed.

    Raises InputError for a value of the wrong kind or out of range."""

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
    bf16: bool = True
    compile: bool = False
    route_steps: int = 600
    validate_every: int = 250
    closed_loop_every: int = 2
    closed_loop_scenes: int = 24
    seed: int = 0

    def __post_init__(self):
        for field in fields(self):
            _check(field.name, field.type, getattr(self, field.name))
        frames = list(self.starts) if hasattr(self.starts, "__iter__") and not isinstance(self.starts, str) else []
        if not frames or any(type(frame) is not int or frame < 0 for frame in frames):
            raise InputError(f"prior.training.starts={self.starts}: expected a list of frame numbers, e.g. [10,30,50]")
        object.__setattr__(self, "starts", tuple(sorted(set(frames))))


def _check(name: str, kind: type, value: object) -> None:
    """InputError where a setting is no number (or truth value) of its kind or out of its range."""
    where = f"prior.training.{name}={value}"
    if kind is bool and not isinstance(value, bool):
        raise InputError(f"{where}: expected true or false")
    if kind not in (int, float):
        return
    number = type(value) is int or (kind is float and type(value) is float and math.isfinite(value))
    low, high = AT_LEAST.get(name, -math.inf), AT_MOST.get(name, math.inf)
    if not number or not low <= value <= high:
        text = "a whole number" if kind is int else "a number"
        text += f" of at least {low:g}" if low > -math.inf else ""
        raise InputError(f"{where}: expected {text}" + (f" and at most {high:g}" if high < math.inf else ""))
