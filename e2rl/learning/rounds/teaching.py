"""A planner's labels in states that the policy comes to (DAgger, Ross, Gordon and
Bagnell 2011), where they matter.

A label of every state teaches the planner's speed: it would rather drive faster nearly
everywhere. What it knows better is how to get away. So states are labelled shortly
before a contact or a near miss, and of these only where, by the planner's costs, the
policy's own plan is worse by far and the planner's is not a contact itself.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from e2rl.learning.pretraining.cloning import clip_expert
from e2rl.planners.ego import Ego
from e2rl.planners.ego_policy import ask
from e2rl.planners.sampling import ScoringEgo, ranked_actions
from e2rl.run.config import configured, setting
from e2rl.run.errors import InputError
from e2rl.scenes.recording import DT
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import touches
from e2rl.sim.prospects import time_to_contact
from e2rl.sim.world import World
from e2rl.traffic.e2.skeleton import first_after

BATCH = 32  # states that are labelled at once
GPU_BATCH = 2048
CANDIDATES = 48  # soft labels: the teacher's cheapest, of which the nearest ones draw
TEMPERATURE = 5.0  # of their weights softmax(-cost / TEMPERATURE)
COSTLY = 60.0  # cost from which on a plan counts as one that ends in a contact
NO_ROWS = torch.zeros(0, dtype=torch.int64)
NO_FLAGS = torch.zeros(0, dtype=torch.bool)


@configured("learner/ppo_bc", "teaching")
@dataclass(frozen=True)
class TeachingSettings:
    """Settings `learner.teaching`."""

    states: int = setting(low=1)
    memory: int = setting(low=1)
    window: float = setting(low=0)
    near: float = setting(low=0)
    regret: float = setting()
    survivable: float = setting()


def critical(data: TensorDictBase, window: float, near: float) -> Tensor:
    """Bool [B, T]: decisions of a collected batch at most `window` s before a contact,
    or before a near miss: less than `near` s to a contact if the ego goes on. Both in
    the same episode."""
    metrics = data["next", "metrics"]
    length = data.shape[1]
    contact = touches(metrics)[..., 0]
    event = first_after(contact | (time_to_contact(data["observation"]) < near))[:, :-1]
    step = data["timestep"][..., 0]
    wait = step.gather(1, event.clamp(max=length - 1)) - step
    end = first_after(data["next", "done"][..., 0])[:, :-1]
    return (event < length) & (event <= end) & (wait * DT <= window)


@dataclass
class Teacher:
    """Labels states of collected batches; `labelled` [M]
    (e2rl/learning/pretraining/cloning.py) are the newest ones of all rounds.

    It knows of the others what it sees, so that a critical decision from which it would
    get away, where the policy would not, is one that the policy has to learn:
    `survivable`.

    Args:
        planner: that labels.
        scenes: of the states.
        low: lowest action [2].
        high: highest action [2].
        hold: steps of a decision.
        settings: which states are labelled.

    Raises:
        InputError: the planner does not rank candidates.
    """

    planner: ScoringEgo
    scenes: SceneSet
    low: Tensor
    high: Tensor
    hold: int
    settings: TeachingSettings

    def __post_init__(self) -> None:
        if not isinstance(self.planner, ScoringEgo):
            raise InputError(
                f"learner.teacher={type(self.planner).__name__}: it cannot tell what its "
                "candidates cost; take an ScoringEgo such as "
                "e2rl.planners.sampling.SamplingEgo, or set learner.ppo.teaching=0"
            )
        self.labelled: TensorDict | None = None
        self._judged = NO_ROWS  # rows of the pool of decisions that were judged
        self._survived = NO_FLAGS  # which of them the planner alone survives

    def survivable(self, rows: int) -> Tensor:
        """Of the decisions judged in each of the pool's rows, the fraction [R] that the
        planner survives and the policy's plan does not; NaN in rows without any. Then
        all counts are reset."""
        survived = torch.bincount(self._judged, self._survived.float(), rows)
        fraction = survived / torch.bincount(self._judged, minlength=rows)
        self._judged = NO_ROWS
        self._survived = NO_FLAGS
        return fraction

    def watch(
        self,
        data: TensorDictBase,
        adversarial: Tensor,
        ego: Ego,
        count: int,
    ) -> dict[str, float]:
        """Label critical decisions of adversarial episodes, drawn evenly.

        Args:
            data: a batch [B, T] that `ego` drove.
            adversarial: of the pool's rows, [R] bool.
            ego: whose plans are judged.
            count: decisions looked at, at most.

        Returns:
            How many critical ones there were, and the labels that they made.
        """
        attacked = adversarial.to(data.device)[data["traffic", "row"][..., 0]]
        places = (
            attacked & critical(data, self.settings.window, near=self.settings.near)
        ).nonzero()
        order = torch.randperm(len(places), device=places.device)
        row, column = places[order[:count]].unbind(1)
        if not len(row):
            return {"critical": 0.0, "labels": 0.0}
        frames = data.select("observation", "timestep", "scene_index", "agents")
        size = GPU_BATCH if data.device.type == "cuda" else BATCH
        labels = []
        survived = [self._survived]
        for part in frames[row, column].split(size):
            label, escapes = self.labels(part, ego)
            labels.append(label)
            survived.append(escapes.cpu())
        older = [] if self.labelled is None else [self.labelled]
        self.labelled = torch.cat([*older, *labels])[-self.settings.memory :]
        rows = data["traffic", "row"][row, column, 0].cpu()
        self._judged = torch.cat([self._judged, rows])
        self._survived = torch.cat(survived)
        return {"critical": float(len(places)), "labels": float(sum(map(len, labels)))}

    def labels(self, frames: TensorDictBase, ego: Ego) -> tuple[TensorDict, Tensor]:
        """Labels [K] of the states frames [M] of a DrivingEnv with `agents=True` in
        which ego's plan costs at least `regret` more than the planner's, whose own cost
        is below `survivable`; and bool [M]: where the planner survives and ego's plan
        does not."""
        settings = self.settings
        world = World.of(frames, self.scenes.batch(frames["scene_index"][:, 0]))
        action, cost = ranked_actions(
            self.planner,
            world,
            count=CANDIDATES,
            hold=self.hold,
        )
        plan = ask(ego, "plan", world=world)[:, None]
        rated = self.planner.rated(world, plan)[:, 0]
        best = cost[:, 0]
        labels = {
            "observation": frames["observation"],
            "action": clip_expert(action, self.low, high=self.high),
            "weight": torch.softmax(-cost / TEMPERATURE, -1),
        }
        chosen = (rated - best >= settings.regret) & (best < settings.survivable)
        escapes = (rated >= COSTLY) & (best < COSTLY)
        return TensorDict(labels, batch_size=frames.batch_size)[chosen], escapes

    def state_dict(self) -> dict:
        """The labels, of plain tensors."""
        return {} if self.labelled is None else self.labelled.to_dict()

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        self.labelled = None
        if state:
            labels = TensorDict(state, [len(state["weight"])])
            self.labelled = labels.to(self.low.device)
