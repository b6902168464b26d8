"""The learned ego's network: observation normalisation, squashed Gaussian actor,
critic, and their file."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator

from e2rl.planners.reference import LAST_ACTION, Trunk, follow, linear
from e2rl.run.errors import InputError
from e2rl.run.files import altered, read_weights, weight_bytes, write_atomically
from e2rl.run.fused import is_on
from e2rl.sim.observation import OBSERVATION_SIZE

DEEPEST, WIDEST = 16, 1 << 13  # layers, and units of a layer, that a file may ask for
WEIGHTS = "actor.safetensors"  # file name of an ActorCritic inside a checkpoint
NARROWEST = 0.01  # least standard deviation before squashing, as a fraction of half the action range
LAST = {"network.trunk.last.weight", "network.trunk.last.bias"}
STEEPEST = 0.95  # reference actions are kept within this fraction of the bounds, so that their atanh stays finite
UNBOUNDED = 0.999  # and a bound of the acceleration, where nobody is ahead
LEAST_SCALE = 0.2  # an observed number's: one that hardly varied in training, as the ego's size, may vary elsewhere


class Normaliser(nn.Module):
    """Running mean and variance of observations; only `observe` changes them, so
    evaluation leaves them frozen."""

    count: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(self, size: int, least_scale: float = 0.05) -> None:
        super().__init__()
        self.least_scale = least_scale
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))

    @torch.no_grad()
    def observe(self, observation: Tensor) -> None:
        """Update the statistics with observations [..., D] (Chan et al.'s pairwise
        update)."""
        flat = observation.reshape(-1, observation.shape[-1])
        total = self.count + len(flat)
        weight = (len(flat) / total).float()
        mean = flat.mean(0)
        delta = mean - self.mean
        variance = (
            (flat - mean).square().mean(0) if is_on() else flat.var(0, correction=0)
        )  # which takes long
        spread = self.variance * (1 - weight) + variance * weight
        self.variance.copy_(spread + delta**2 * weight * (1 - weight))
        self.mean.add_(delta * weight)
        self.count.copy_(total)

    def forward(self, observation: Tensor) -> Tensor:
        """Observations less their mean, over their standard deviation or `least_scale`,
        clipped to [-5, 5]."""
        return (
            (observation - self.mean) / self.variance.sqrt().clamp(min=self.least_scale)
        ).clamp(-5, 5)


class ActorNetwork(nn.Module):
    """Mean and standard deviation of the action before squashing.

    The mean is r + g (c + w r): r is the reference's action (if `reference`, else 0), c
    and w [2] the network's output. It can let go of the reference (w = -1), which it
    could not cancel without knowing it: near a contact r jumps from full speed to full
    braking. The output starts at zero: an untrained actor executes the reference's
    action, or without a reference the middle of the action's bounds.

    With `room` the gate g rises from 0 where the reference has `room` m left (`follow`)
    to 1 where it has half of it, so that the network drives in danger alone; else g =
    1. With `slack` the mean's acceleration exceeds the bound of `follow` by `slack`
    m/s^2 at most: what is learned against attackers keeps the distance to the vehicle
    ahead.
    """

    middle: Tensor
    reach: Tensor

    def __init__(
        self,
        normaliser: Normaliser,
        hidden: Sequence[int],
        agent_units: int,
        reference: bool,
        slack: float | None,
        room: float | None,
        initial_std: Sequence[float],
        low: Tensor,
        high: Tensor,
    ) -> None:
        super().__init__()
        self.normaliser = normaliser
        self.reference = reference
        self.slack = slack
        self.room = room
        self.trunk = Trunk(
            hidden, agent_units, out=4 if reference else 2, last_gain=0.0
        )
        self.spread = nn.Parameter((torch.tensor(initial_std) - NARROWEST).logit(1e-4))
        self.noise: Tensor | None = None  # [D], set by `noisy`
        self.register_buffer("middle", (high + low) / 2, persistent=False)
        self.register_buffer("reach", (high - low) / 2, persistent=False)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """loc, scale [..., 2] from observation [..., D]."""
        seen = self.normaliser(observation)
        if self.noise is not None:
            seen = seen + self.noise * torch.randn_like(seen)
        return self.head(seen, self.offset(observation))

    def offset(self, observation: Tensor) -> Tensor:
        """r, the bound of the acceleration and g, [..., 4], at observation [..., D]: no
        parameter changes them."""
        if not self.reference:
            return torch.zeros_like(observation[..., :4])
        found = follow(observation)
        part = ((found[..., :2] - self.middle) / self.reach).clamp(-STEEPEST, STEEPEST)
        bound = (found[..., 2:3] + (self.slack or 0.0) - self.middle[:1]) / self.reach[
            :1
        ]
        gate = (
            torch.ones_like(bound)
            if self.room is None
            else (2 - 2 * found[..., 3:] / self.room).clamp(0, 1)
        )
        return torch.cat(
            [part.atanh(), bound.clamp(-STEEPEST, UNBOUNDED).atanh(), gate], -1
        )

    def head(self, seen: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
        """loc, scale [..., 2] from the normalised observation [..., D] and the `offset`
        [..., 4]."""
        loc = self.trunk(seen)
        if self.reference:
            usual, bound, gate = offset.split((2, 1, 1), -1)
            loc = usual + gate * (loc[..., :2] + loc[..., 2:] * usual)
            if self.slack is not None:
                loc = torch.cat([torch.minimum(loc[..., :1], bound), loc[..., 1:]], -1)
        return loc, self.std.expand_as(loc)

    @contextmanager
    def noisy(self, features: float, last_action: float) -> Iterator[None]:
        """While cloning: noise of these standard deviations on the network's normalised
        input, not the reference's."""
        self.noise = torch.full_like(self.normaliser.mean, features)
        self.noise[list(LAST_ACTION)] = last_action
        try:
            yield
        finally:
            self.noise = None

    @property
    def std(self) -> Tensor:
        """Standard deviations [2] before squashing, in halves of the action's range."""
        return NARROWEST + self.spread.sigmoid()

    def deterministic(self, observation: Tensor) -> Tensor:
        """Most central action [..., 2] (m/s^2, rad/s)."""
        return self.middle + self.reach * self(observation)[0].tanh()


class ActorCritic(nn.Module):
    """TorchRL actor and critic over one normaliser.

    actor reads "observation", writes loc, scale, action, action_log_prob; critic writes
    state_value.
    """

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        hidden: Sequence[int] = (128, 128),
        agent_units: int = 32,
        reference: bool = True,
        slack: float | None = None,
        room: float | None = None,
        initial_std: Sequence[float] = (0.25, 0.12),
        device: str | torch.device = "cpu",
        least_scale: float = LEAST_SCALE,
    ) -> None:
        """low, high [2]: bounds of (acceleration, yaw rate); least_scale: of an
        observed number; other fields: conf/ego/actor.yaml."""
        super().__init__()
        device = torch.device(device)
        low = low.to(device, torch.float32)
        high = high.to(device, torch.float32)
        self.low = low
        self.high = high
        self.device = device
        self.architecture = {
            "observation": OBSERVATION_SIZE,
            "hidden": [int(size) for size in hidden],
            "agent_units": int(agent_units),
            "reference": bool(reference),
            "slack": None if slack is None else float(slack),
            "room": None if room is None else float(room),
            "least_scale": least_scale,
            "low": _rounded(low),
            "high": _rounded(high),
        }
        self.normaliser = Normaliser(OBSERVATION_SIZE, least_scale)
        sizes = hidden, agent_units, reference, slack, room, initial_std
        self.network = ActorNetwork(self.normaliser, *sizes, low.cpu(), high.cpu())
        values = nn.Sequential(
            self.normaliser, Trunk(hidden, agent_units, out=1, last_gain=1.0)
        )
        self.to(device)
        self.actor = self._sampler(
            TensorDictModule(self.network, ["observation"], ["loc", "scale"])
        )
        self.critic = ValueOperator(values.to(device), in_keys=["observation"])

    def heads(self) -> tuple[ProbabilisticActor, ValueOperator]:
        """Actor and critic with the same parameters that read "seen" and "offset",
        which an update computes once for all its epochs (`prepared`), instead of the
        observation."""
        head = TensorDictModule(self.network.head, ["seen", "offset"], ["loc", "scale"])
        return self._sampler(head), ValueOperator(
            self.critic.module[1], in_keys=["seen"]
        )

    @torch.no_grad()
    def prepared(self, observation: Tensor) -> dict[str, Tensor]:
        """What `heads` read, of observations [..., D]: seen [..., D] and offset [...,
        4]."""
        return {
            "seen": self.normaliser(observation),
            "offset": self.network.offset(observation),
        }

    def _sampler(self, module: TensorDictModule) -> ProbabilisticActor:
        return ProbabilisticActor(
            module,
            in_keys=["loc", "scale"],
            out_keys=["action"],
            distribution_class=TanhNormal,
            distribution_kwargs={"low": self.low, "high": self.high},
            spec=Bounded(self.low, self.high, device=self.device),
            return_log_prob=True,
        )

    def save(self, path: Path) -> None:
        """Write weights and statistics to a safetensors file whose header holds the
        architecture."""
        header = {"architecture": json.dumps(self.architecture, sort_keys=True)}
        write_atomically(path, weight_bytes(self.weights(), header))

    def load(self, path: Path) -> None:
        """Read a file of `save`; raises InputError for a damaged file or another
        architecture."""
        with torch.random.fork_rng(devices=[]):  # building it draws its first weights
            other = read_actor(path, self.device)
        keys = [
            key
            for key, value in self.architecture.items()
            if other.architecture[key] != value
        ]
        if keys:
            differ = ", ".join(
                f"{key} {other.architecture[key]} instead of {self.architecture[key]}"
                for key in keys
            )
            raise InputError(
                f"{path}: an actor of another architecture: {differ}; set ego.* and sim.* as in the run that wrote it"
            )
        self.set_weights(other.weights())

    @torch.no_grad()
    def set_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Load the values of `weights()`, in place."""
        for key, value in self.weights().items():
            value.copy_(weights[key])

    def copied(self, device: str | torch.device) -> "ActorCritic":
        """A copy on another device."""
        of: dict[str, Any] = self.architecture
        sizes = (
            of["hidden"],
            of["agent_units"],
            of["reference"],
            of["slack"],
            of["room"],
        )
        with torch.random.fork_rng(devices=[]):  # building it draws its first weights
            found = ActorCritic(
                self.low,
                self.high,
                *sizes,
                device=device,
                least_scale=of["least_scale"],
            )
        found.set_weights(self.weights())
        return found

    def weights(self) -> dict[str, Tensor]:
        """Every parameter and buffer once (actor and critic share the normaliser)."""
        named = dict(self.named_parameters()) | dict(self.named_buffers())
        kept = {
            key: value
            for key, value in named.items()
            if not key.endswith((".middle", ".reach"))
        }
        return {
            key: value for key, value in kept.items() if not key.startswith("actor.")
        }


def read_actor(path: Path, device: str | torch.device = "cpu") -> ActorCritic:
    """The actor of a file of `ActorCritic.save`, whatever its architecture; raises
    InputError."""
    try:
        weights, header = read_weights(path)
        if "architecture" not in header:
            raise InputError(
                f"{path}: no actor (format {header.get('format')}); pass actor.safetensors, or the folder of a run of "
                "train.py (a prior is given by prior.checkpoint=)"
            )
        saved = json.loads(header["architecture"])
        low, high = (
            torch.tensor(saved[key], dtype=torch.float32).reshape(2)
            for key in ("low", "high")
        )
        sizes = [int(size) for size in saved["hidden"]]
        units = int(saved["agent_units"])
        slack, room = (
            None if saved.get(key) is None else float(saved[key])
            for key in ("slack", "room")
        )
        least = float(
            saved.get("least_scale", 0.05)
        )  # of earlier versions, which had no bounds either
        fits = 0 < len(sizes) <= DEEPEST and all(
            0 < size <= WIDEST for size in [*sizes, units]
        )
        if saved["observation"] != OBSERVATION_SIZE or not fits:
            raise ValueError(
                f"of {saved['observation']} numbers, {units} units an agent, layers of {sizes} units"
            )
        positive = all(
            0 < value < torch.inf for value in (least, 1.0 if room is None else room)
        )
        if not (positive and 0 <= (slack or 0.0) < torch.inf):
            raise ValueError(f"slack {slack}, room {room}, least_scale {least}")
        how = units, bool(saved["reference"]), slack, room
        actor = ActorCritic(low, high, sizes, *how, device=device, least_scale=least)
        own = actor.weights()
        for key in LAST.intersection(weights) if saved["reference"] else ():
            if len(weights[key]) == 2:  # of an earlier version, which had no w: it is 0
                weights[key] = torch.cat([weights[key], torch.zeros_like(weights[key])])
        wrong = set(own) ^ set(weights) or {
            key for key in own if own[key].shape != weights[key].shape
        }
        if wrong:
            raise ValueError(f"weights {', '.join(sorted(wrong))} do not fit")
    except InputError:
        raise
    except (
        TypeError,
        KeyError,
        ValueError,
        RuntimeError,
    ) as error:  # RecursionError among them
        raise InputError(
            f"{path}: damaged, or an actor of another version ({error}); train it again"
        ) from None
    actor.set_weights(weights)
    return actor


def find_weights(path: str | Path) -> Path:
    """The actor file that `path` names: the file, a checkpoint folder, the newest whole
    checkpoint of a run folder, or with "bundled" the package's own, trained on the
    bundled scenes."""
    path = (
        Path(str(files("e2rl") / "assets" / "actor" / WEIGHTS))
        if path == "bundled"
        else Path(path)
    )
    if (path / WEIGHTS).is_file():
        return path / WEIGHTS
    if found := sorted(path.glob(f"checkpoints/round-*/{WEIGHTS}")):
        whole = [file for file in found if altered(file.parent) is None]
        if not whole:
            last = found[-1].parent
            raise InputError(
                f"{last}: damaged ({altered(last)}), as all of {path}; train again"
            )
        return whole[-1]
    if not path.is_file():
        raise InputError(
            f"{path}: no actor there; give an {WEIGHTS}, a checkpoint folder or a run folder"
        )
    return path


def perceptron(
    size: int, hidden: Sequence[int], out: int, last_gain: float
) -> nn.Sequential:
    """Layers size -> hidden -> out with SiLU; orthogonal weights, the last layer's
    scaled by last_gain."""
    sizes = [size, *hidden, out]
    gains = [*[2**0.5] * len(hidden), last_gain]
    layers = [
        linear(*shape) for shape in zip(sizes[:-1], sizes[1:], gains, strict=True)
    ]
    return nn.Sequential(
        *(module for layer in layers[:-1] for module in (layer, nn.SiLU())), layers[-1]
    )


def _rounded(value: Tensor) -> list[float]:
    return [round(number, 6) for number in value.tolist()]
