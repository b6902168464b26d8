"""The learned ego's network: squashed Gaussian actor, critic, and their file."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator

from e2rl.planners.reference import EVASION, LAST_ACTION, follow
from e2rl.planners.trunk import Normaliser, Trunk
from e2rl.run.errors import InputError
from e2rl.run.files import altered, check_format, write_atomically
from e2rl.run.weights import read_weights, weight_bytes
from e2rl.sim.observation import OBSERVATION_SIZE

FORMAT = "e2rl-actor/1"
FIRST = "e2rl-actor/1"  # of a file that has an architecture and says no format
WEIGHTS = "actor.safetensors"  # file name of an ActorCritic inside a checkpoint
DEEPEST = 16  # layers that a file may ask for
WIDEST = 1 << 13  # units of a layer that a file may ask for
NARROWEST = 0.01  # least standard deviation before squashing, in halves of the range
STEEPEST = 0.95  # of the bounds, at most: reference actions, so that atanh is finite
UNBOUNDED = 0.999  # and a bound of the acceleration, where nobody is ahead
LEAST_SCALE = 0.2  # of an observed number that hardly varied in training, as a size
FIXED = {"observation": OBSERVATION_SIZE, "least_scale": LEAST_SCALE}


@dataclass(frozen=True)
class Architecture:
    """What the file of an actor says of its network: bounds of (acceleration, yaw
    rate), and fields of conf/ego/actor.yaml."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    hidden: tuple[int, ...]
    agent_units: int
    reference: bool
    slack: float | None
    room: float | None
    evades: bool

    def header(self) -> str:
        """It as JSON, with what all actors of this version have in common."""
        return json.dumps(FIXED | asdict(self), sort_keys=True)

    @classmethod
    def of_header(cls, header: str) -> "Architecture":
        """Reads `header`. Raises ValueError, TypeError or KeyError where no network has
        it."""
        saved = json.loads(header)
        low, high = (tuple(map(float, saved[key])) for key in ("low", "high"))
        slack, room = (
            None if saved[key] is None else float(saved[key])
            for key in ("slack", "room")
        )
        hidden = tuple(map(int, saved["hidden"]))
        units = int(saved["agent_units"])
        valid = (
            all(saved[key] == value for key, value in FIXED.items())
            and len(low) == len(high) == 2
            and 0 < len(hidden) <= DEEPEST
            and all(0 < size <= WIDEST for size in (*hidden, units))
            and (slack is None or 0 <= slack < torch.inf)
            and (room is None or 0 < room < torch.inf)
            and (room is not None or not saved.get("evades"))
        )
        if not valid:
            raise ValueError(f"architecture {header[:300]}")
        return cls(
            low,
            high,
            hidden=hidden,
            agent_units=units,
            reference=bool(saved["reference"]),
            slack=slack,
            room=room,
            evades=bool(saved.get("evades", False)),  # older files lack it
        )


class ActorNetwork(nn.Module):
    """Mean and standard deviation of the action before squashing.

    The mean is r + g (c + w r): r is the reference's action (if `reference`, else 0), c
    and w [2] the network's output. It can let go of the reference (w = -1), which it
    could not cancel without knowing it: near a contact r jumps from full speed to full
    braking. The output starts at zero: an untrained actor executes the reference's
    action, or without a reference the middle of the action's bounds.

    With `room` the gate g rises from 0 where the reference has `room` m left (`follow`)
    to 1 where it has half of it, so that the network drives in danger alone; else g =
    1. There r is a planner's action if one evades (`evader.Evader`). With `slack` the
    mean's acceleration exceeds the bound of `follow` by `slack` m/s^2 at most, but for
    the planner's own, and the planner's own by as much: what is learned against
    attackers keeps the distance to the vehicle ahead, and does not undo that a planner
    brakes.
    """

    middle: Tensor
    reach: Tensor

    def __init__(
        self,
        normaliser: Normaliser,
        architecture: Architecture,
        initial_std: Sequence[float],
    ) -> None:
        super().__init__()
        self.normaliser = normaliser
        self.reference = architecture.reference
        self.slack = architecture.slack
        self.room = architecture.room
        self.trunk = Trunk(
            architecture.hidden,
            architecture.agent_units,
            out=4 if self.reference else 2,
            last_gain=0.0,
        )
        self.spread = nn.Parameter((torch.tensor(initial_std) - NARROWEST).logit(1e-4))
        self.noise: Tensor | None = None  # [D], set by `noisy`
        low = torch.tensor(architecture.low)
        high = torch.tensor(architecture.high)
        self.register_buffer(
            "middle",
            (high + low) / 2,
            persistent=False,
        )
        self.register_buffer(
            "reach",
            (high - low) / 2,
            persistent=False,
        )

    def forward(
        self, observation: Tensor, evasion: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """loc, scale [..., 2] from observation [..., D] and, if a planner evades, its
        action [..., 2], NaN where it does not."""
        normalised = self.normaliser(observation)
        if self.noise is not None:
            normalised = normalised + self.noise * torch.randn_like(normalised)
        return self.head(normalised, self.offset(observation, evasion))

    def offset(self, observation: Tensor, evasion: Tensor | None = None) -> Tensor:
        """r, the bound of the acceleration and g, [..., 4], at observation [..., D] and
        evasion [..., 2]: no parameter changes them."""
        if not self.reference:
            return torch.zeros_like(observation[..., :4])
        followed = follow(observation)
        action = followed[..., :2]
        slack = self.slack or 0.0
        limit = followed[..., 2:3] + slack
        if evasion is not None:
            evades = ~evasion.isnan()
            action = torch.where(evades, evasion, action)
            planned = evasion[..., :1]
            most = torch.minimum(torch.maximum(limit, planned), planned + slack)
            limit = torch.where(evades[..., :1], most, limit)
        action = (action - self.middle) / self.reach
        bound = (limit - self.middle[:1]) / self.reach[:1]
        gate = torch.ones_like(bound)
        if self.room is not None:
            gate = (2 - 2 * followed[..., 3:] / self.room).clamp(0, 1)
        action = action.clamp(-STEEPEST, STEEPEST).atanh()
        bound = bound.clamp(-STEEPEST, UNBOUNDED).atanh()
        return torch.cat([action, bound, gate], -1)

    def head(self, normalised: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
        """loc, scale [..., 2] from the normalised observation [..., D] and the `offset`
        [..., 4]."""
        loc = self.trunk(normalised)
        if self.reference:
            action, bound, gate = offset.split((2, 1, 1), -1)
            loc = action + gate * (loc[..., :2] + loc[..., 2:] * action)
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

    def deterministic(
        self, observation: Tensor, evasion: Tensor | None = None
    ) -> Tensor:
        """Most central action [..., 2] (m/s^2, rad/s)."""
        return self.middle + self.reach * self(observation, evasion)[0].tanh()


class ActorCritic(nn.Module):
    """TorchRL actor and critic over one normaliser.

    actor reads "observation" and, if it evades, "evasion", and writes loc, scale,
    action, action_log_prob; critic writes state_value.
    """

    def __init__(
        self,
        architecture: Architecture,
        initial_std: Sequence[float] = (0.25, 0.12),
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__()
        self.architecture = architecture
        self.device = torch.device(device)
        self.low = torch.tensor(architecture.low, device=self.device)
        self.high = torch.tensor(architecture.high, device=self.device)
        self.normaliser = Normaliser(OBSERVATION_SIZE, LEAST_SCALE)
        self.network = ActorNetwork(self.normaliser, architecture, initial_std)
        trunk = Trunk(
            architecture.hidden,
            architecture.agent_units,
            out=1,
            last_gain=1.0,
        )
        values = nn.Sequential(self.normaliser, trunk)
        self.to(self.device)
        inputs = ["observation", EVASION] if architecture.evades else ["observation"]
        self.inputs = tuple(inputs)
        self.actor = self._sampler(
            TensorDictModule(self.network, inputs, ["loc", "scale"])
        )
        self.critic = ValueOperator(values.to(self.device), in_keys=["observation"])

    def heads(self) -> tuple[ProbabilisticActor, ValueOperator]:
        """Actor and critic with the same parameters that read "seen" and "offset",
        which an update computes once for all its epochs (`prepared`), instead of the
        observation."""
        head = TensorDictModule(self.network.head, ["seen", "offset"], ["loc", "scale"])
        critic = ValueOperator(self.critic.module[1], in_keys=["seen"])
        return self._sampler(head), critic

    @torch.no_grad()
    def prepared(self, frames: TensorDictBase) -> dict[str, Tensor]:
        """What `heads` read, of frames [...] with the actor's `inputs`: seen [..., D]
        and offset [..., 4]."""
        observation = frames["observation"]
        return {
            "seen": self.normaliser(observation),
            "offset": self.network.offset(observation, frames.get(EVASION, None)),
        }

    def _sampler(self, module: TensorDictModule) -> ProbabilisticActor:
        return ProbabilisticActor(
            module,
            in_keys=["loc", "scale"],
            out_keys=["action"],
            distribution_class=TanhNormal,
            distribution_kwargs={"low": self.low, "high": self.high},
            spec=Bounded(
                self.low,
                self.high,
                device=self.device,
            ),
            return_log_prob=True,
        )

    def save(self, path: Path) -> None:
        """Write weights and statistics to a safetensors file whose header holds the
        architecture."""
        header = {"format": FORMAT, "architecture": self.architecture.header()}
        write_atomically(path, weight_bytes(self.weights(), header))

    def load(self, path: Path) -> None:
        """Read a file of `save`; raises InputError for a damaged file or another
        architecture."""
        with torch.random.fork_rng(devices=[]):  # building it draws its first weights
            other = read_actor(path, self.device)
        if other.architecture != self.architecture:
            raise InputError(
                f"{path}: an actor of another architecture: {other.architecture} instead "
                f"of {self.architecture}; set ego.* and sim.* as in the run that wrote it"
            )
        self.set_weights(other.weights())

    @torch.no_grad()
    def set_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Load the values of `weights()`, in place."""
        for key, value in self.weights().items():
            value.copy_(weights[key])

    def copied(self, device: str | torch.device) -> "ActorCritic":
        """A copy on another device."""
        with torch.random.fork_rng(devices=[]):  # building it draws its first weights
            copy = ActorCritic(self.architecture, device=device)
        copy.set_weights(self.weights())
        return copy

    def weights(self) -> dict[str, Tensor]:
        """Every parameter and buffer once (actor and critic share the normaliser)."""
        return {
            name: value
            for name, value in (*self.named_parameters(), *self.named_buffers())
            if not name.startswith("actor.") and not name.endswith(("middle", "reach"))
        }


def read_actor(path: Path, device: str | torch.device = "cpu") -> ActorCritic:
    """The actor of a file of `ActorCritic.save`, whatever its architecture; raises
    InputError."""
    try:
        weights, header = read_weights(path)
        written = header.get("format", FIRST if "architecture" in header else None)
        mend = "pass actor.safetensors, or the folder of a run of train.py"
        mend += " (a prior is given by prior.checkpoint=)"
        check_format(path, written, expected=FORMAT, mend=mend)
        architecture = Architecture.of_header(header["architecture"])
        actor = ActorCritic(architecture, device=device)
        shapes = {name: value.shape for name, value in weights.items()}
        if shapes != {name: value.shape for name, value in actor.weights().items()}:
            raise ValueError("its weights do not fit")
    except InputError:
        raise
    except (TypeError, LookupError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(
            f"{path}: damaged, or another architecture ({error}); train it again"
        ) from None
    actor.set_weights(weights)
    return actor


def find_weights(path: str | Path) -> Path:
    """The actor file that `path` names: the file, a checkpoint folder, the newest whole
    checkpoint of a run folder, or with "bundled" the package's own, trained on the
    bundled scenes."""
    if path == "bundled":
        path = str(files("e2rl") / "assets" / "actor")
    path = Path(path)
    if (path / WEIGHTS).is_file():
        return path / WEIGHTS
    checkpoints = sorted(path.glob(f"checkpoints/round-*/{WEIGHTS}"))
    for file in reversed(checkpoints):
        if altered(file.parent) is None:
            return file
    if checkpoints:
        newest = checkpoints[-1].parent
        raise InputError(
            f"{newest}: damaged ({altered(newest)}), as all of {path}; train again"
        )
    if not path.is_file():
        raise InputError(
            f"{path}: no actor there; give an {WEIGHTS}, a checkpoint folder or a run "
            "folder"
        )
    return path
