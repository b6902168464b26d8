"""The learned ego: acts on the environment's observation; its plan is a rollout of its own policy."""

from collections.abc import Sequence

import torch
from torch import Tensor

from e2rl.planners.network import ActorCritic, find_weights, read_actor
from e2rl.planners.observing import ObservingEgo
from e2rl.run.errors import InputError
from e2rl.run.settings import check_range


class ActorEgo(ObservingEgo):
    """Drives by the actor's most central action; the learner updates `network` in place."""

    def __init__(
        self,
        hidden: Sequence[int] = (128, 128),
        agent_units: int = 32,
        reference: bool = True,
        initial_std: Sequence[float] = (0.25, 0.12),
        max_acceleration: float = 5.0,
        max_braking: float = 8.0,
        max_yaw_rate: float = 1.6,
        checkpoint: str | None = None,
        device: str = "cpu",
    ) -> None:
        """Fields: conf/ego/actor.yaml; with a checkpoint, the network is the file's. Raises InputError if it is missing
        or its actions have other bounds."""
        super().__init__()
        check_range("ego.agent_units", agent_units, 1)
        if not hidden:
            raise InputError("ego.hidden=[]: give the units of one layer at least")
        low, high = torch.tensor([-max_braking, -max_yaw_rate]), torch.tensor([max_acceleration, max_yaw_rate])
        self.network = ActorCritic(low, high, hidden, agent_units, reference, initial_std, device)
        if checkpoint is not None:
            bounds, path = bounds_of(self.network), find_weights(checkpoint)
            self.network = read_actor(path, device)
            if bounds_of(self.network) != bounds:
                raise InputError(
                    f"{path}: its actions have the bounds {bounds_of(self.network)}, not {bounds}; set sim.max_* as in "
                    "the run that wrote it"
                )

    def decide(self, observation: Tensor) -> Tensor:
        """Most central action [B, 2] at the observation."""
        return self.network.network.deterministic(observation)


def bounds_of(network: ActorCritic) -> tuple[object, object]:
    """Lowest and highest action (m/s^2, rad/s), as the network's file states them."""
    return network.architecture["low"], network.architecture["high"]
