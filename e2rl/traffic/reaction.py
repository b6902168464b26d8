"""The extension point for vehicles that leave replayed traffic and react to the ego."""

from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Tensor

from e2rl.sim.world import World


class NewEpisodes(NamedTuple):
    """b episodes that begin in a batch of environments.

    rows [b] int64: their environments; adversarial [b] bool: replayed traffic with an intensity; adversaries [b, V]
    bool: of that traffic; batch: environments in all; horizon: steps of an episode.
    """

    rows: Tensor
    adversarial: Tensor
    adversaries: Tensor
    batch: int
    horizon: int


class Motion(NamedTuple):
    """The coming states [K, H, 4] of vehicles agents [K] of environments rows [K]."""

    rows: Tensor
    agents: Tensor
    states: Tensor


class Reaction(ABC):
    """Vehicles of replayed traffic that react: who, from when on, and how."""

    @property
    @abstractmethod
    def acting(self) -> Tensor:
        """Bool [B, V]: vehicles that react now; valid after the first `begin`."""

    @abstractmethod
    def begin(self, episodes: NewEpisodes) -> None:
        """Draw for every new episode whether, who and when; the former episode's vehicles there stop reacting."""

    @abstractmethod
    def react(self, world: World) -> Motion | None:
        """The reacting vehicles' motion for at least 1 s, asked every 0.5 s; None where nobody reacts."""
