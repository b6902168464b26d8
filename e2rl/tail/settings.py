"""What `e2rl rate` estimates, and how (conf/rate.yaml)."""

from dataclasses import dataclass, fields

from e2rl.run.config import configured, setting
from e2rl.tail.level import TARGETS
from e2rl.tail.plain import Plain
from e2rl.tail.sampler import Sampler, SamplerSettings
from e2rl.tail.subset import Subset

METHODS: dict[str, type[Sampler]] = {"subset": Subset, "plain": Plain}


@configured("rate", "rate")
@dataclass(frozen=True)
class RateSettings:
    """What is estimated, and how often; conf/rate.yaml explains each."""

    method: str = setting(choices=METHODS)
    target: str = setting(choices=TARGETS)
    repetitions: int = setting(low=1)
    first: int = setting(low=4)
    particles: int = setting(low=4)
    killed: float = setting(low=0.05, high=0.95)
    moves: int = setting(low=1)
    rollouts: int = setting(low=4)
    least: float = setting(low=0, high=1)
    together: int = setting(low=1)

    @property
    def populations(self) -> int:
        """Of each scene, at most."""
        return self.repetitions if METHODS[self.method].repeated else 1

    @property
    def sampler(self) -> SamplerSettings:
        """Those of one population."""
        names = [field.name for field in fields(SamplerSettings)]
        return SamplerSettings(**{name: getattr(self, name) for name in names})
