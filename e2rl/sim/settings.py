"""Settings of the simulator."""

from dataclasses import dataclass

from e2rl.run.config import configured, setting


@configured("sim/default")
@dataclass
class SimSettings:
    """Bounds of the ego's action, what ends an episode, and the weights of the reward
    (conf/sim/default.yaml)."""

    max_acceleration: float = setting(
        low=0.1,
        high=100.0,
    )
    max_braking: float = setting(
        low=0.1,
        high=100.0,
    )
    max_yaw_rate: float = setting(
        low=0.1,
        high=100.0,
    )
    end_on_contact: bool = setting()
    end_off_road: bool = setting()
    end_when_gone: bool = setting()
    replay_ego: bool = setting()
    reward: dict[str, float] = setting()
