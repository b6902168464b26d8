"""The steps of a round of Algorithm 1, which `train.py` does in turn, and the state of
a run between them."""

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from e2rl.learning.rounds.attack import (
    ATTACK,
    Order,
    Solvable,
    Synthesize,
    counted,
    make_traffic,
)
from e2rl.learning.rounds.episodes import Episodes
from e2rl.learning.rounds.improvement import Improvement
from e2rl.learning.rounds.ladder import Ladder
from e2rl.learning.rounds.memory import Memory
from e2rl.learning.rounds.prefetch import Prefetch
from e2rl.learning.rounds.scheduler import (
    Choice,
    CurriculumScheduler,
    outcomes_of,
    tally,
)
from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego import Ego
from e2rl.run.config import configured, setting
from e2rl.traffic.pool import TrafficPool

TIMES = ("collect", "steps_per_second")  # of an improvement's metrics


@configured("learner/ppo_bc", "round")
@dataclass(frozen=True)
class RoundSettings:
    """Settings `learner.round`."""

    scenes: int = setting(low=1)
    hits: float = setting(low=0, high=1)
    nominal: str = setting(choices=("prior", "log", "none"))
    memory: int = setting(low=0)
    prefetch: bool | None = setting(optional=True)
    harder: dict[str, str] = field(default_factory=dict)


@dataclass
class RoundTraffic:
    """The traffic of a round: the pool, and which of the ordered attacks its first K
    rows are (drawn [K] int64; the others were left out); attacked, contact: fractions
    of the attacks with an adversary, and that hit the ego; errored: rows that could not
    be made; seconds: what it took."""

    pool: TrafficPool
    drawn: Tensor
    attacked: float
    contact: float
    errored: list[dict]
    seconds: dict[str, float]


@dataclass(eq=False)
class Evolution:
    """The state of a run: curriculum, improvement (which holds the ego) and the memory
    of D'.

    Args:
        attacks: the synthesizer's, and a harder one where the settings name one; each
            (ego, scene_index [S], eta [S], seed) -> {scene_index [S], states
            [S, T+1, N, 4], valid [S, T+1, N], adversaries [S, N] bool, contact [S]
            bool}: closed-loop traffic against that ego; contact: it was hit. Rows that
            cannot be made are left out, and `errored` {position in S: why} names them.
        solvable: traffic -> bool [S]: the rows that enter D'; None: all.
        batch: scenes that are synthesized at once.

    After a round, `episodes` are those that the ego drove; `choices` what the
    curriculum chose and what came of it (e2rl/learning/rounds/scheduler.py); `errored`
    the rollouts that errored, each with its reason.
    """

    curriculum: CurriculumScheduler
    improve: Improvement
    attacks: Sequence[Synthesize]
    settings: RoundSettings
    memory: Memory
    seed: int = 0
    solvable: Solvable | None = None
    batch: int = 64
    episodes: Episodes = field(init=False)
    choices: list[Choice] = field(init=False, default_factory=list)
    errored: list[dict] = field(init=False, default_factory=list)
    _ladder: Ladder = field(init=False)
    _next: Order | None = field(init=False, default=None)  # of the coming round
    _prefetch: Prefetch | None = field(init=False, default=None)  # what makes it

    def __post_init__(self) -> None:
        self._ladder = Ladder(self.settings.hits, self.seed)

    @property
    def ego(self) -> Ego:
        """The current ego."""
        return self.improve.ego

    @property
    def round(self) -> int:
        """Rounds done."""
        return self.curriculum.round

    # --- the steps of a round, in their order

    def draw(self) -> Order:
        """Returns what is attacked: scenes and intensities by the curriculum, and the
        current ego."""
        order = self._next or self._order(self.round)
        self._next = None
        return order

    def roll_out(self, order: Order) -> RoundTraffic:
        """Returns the attacks on the ordered ego, without those that no driver avoids,
        with remembered attacks and nominal traffic."""
        begin = time.perf_counter()
        if self.settings.prefetch:
            work = self._prefetch or self._begin(order)
            self._prefetch = None
            seconds = {"synthesize": work.wait()}
            seconds["waiting"] = time.perf_counter() - begin
        else:
            self._make(order)
            seconds = {"synthesize": time.perf_counter() - begin}
        newest = self.memory.take(order.number)
        pool = self.memory.pool()
        if self.settings.nominal == "log" or not len(pool):  # it is never empty
            pool = pool + TrafficPool.recorded(order.scenes)
        contact = newest.traffic["contact"]
        known = ~contact.isnan()
        self._ladder.observe(order.attack[known], contact[known] > 0)
        return RoundTraffic(
            pool,
            newest.traffic["entered"].nonzero()[:, 0],
            attacked=newest.traffic["attacked"].nanmean().item(),
            contact=contact.nanmean().item(),
            errored=newest.errored,
            seconds=seconds,
        )

    def prefetch(self) -> None:
        """With `settings.prefetch`, fix the next round's order, and begin to make it in
        another process.

        What the curriculum learns from the present round then acts two rounds later.
        """
        if self.settings.prefetch:
            self._next = self._order(self.round + 1)
            if self.round + 1 < self.curriculum.rounds:
                self._prefetch = self._begin(self._next)

    def learn(self, attack: RoundTraffic) -> dict[str, float]:
        """Improve the ego in the traffic of the round; returns the metrics of learning,
        named by group."""
        begin = time.perf_counter()
        metrics, self.episodes = self.improve(attack.pool, self.curriculum)
        return {
            "time/improve": time.perf_counter() - begin,
            **{
                f"{'time' if name in TIMES else 'train'}/{name}": value
                for name, value in metrics.items()
            },
        }

    def move_on(
        self,
        order: Order,
        attack: RoundTraffic,
        learned: dict[str, float],
    ) -> dict[str, float]:
        """Move the curriculum by what became of the attacks; returns all metrics of the
        round, named by group (train/, curriculum/, synthesizer/, time/)."""
        curriculum = self.curriculum
        state = curriculum.summary()
        outcomes = outcomes_of(
            order.eta,
            drawn=attack.drawn,
            row=self.episodes.row,
            failed=self.episodes.failed,
        )
        curriculum.update(self.episodes)
        curriculum.advance(attack.contact)
        self.choices = tally(order.number, outcomes, order.attack)
        self.errored = attack.errored
        not_made = sum(entry["during"] == ATTACK for entry in attack.errored)
        attacks = {
            "scenes": float(len(order.scenes)),
            "harder": float(order.attack.sum()),
            "eta": order.eta.mean().item(),
            "left_out": float(outcomes.left_out.sum() - not_made),
            "memory_rows": float(self.memory.rows),
            "attacked": attack.attacked,
            "contact": attack.contact,
            **counted(attack.errored),
        }
        return {
            **{f"curriculum/{name}": value for name, value in state.items()},
            **learned,
            **{f"synthesizer/{name}": value for name, value in attacks.items()},
            **{f"time/{name}": value for name, value in attack.seconds.items()},
        }

    # --- their parts

    def _order(self, number: int) -> Order:
        """What is to be synthesized for a round, as the curriculum and the ego are now."""
        scenes = self.curriculum.draw(self.settings.scenes)
        attack = torch.zeros(len(scenes), dtype=torch.int64)
        if len(self.attacks) > 1:
            attack, place = self._ladder.draw(len(scenes)).sort(stable=True)
            scenes = scenes[place]
        ego = self.ego
        if self.settings.prefetch:  # learning changes weights in place
            ego = copy.deepcopy(ego)
        return Order(
            number,
            scenes,
            attack=attack,
            eta=self.curriculum.etas(scenes),
            seed=self.seed * 1_000_003 + number,
            ego=ego,
        )

    def _begin(self, order: Order) -> Prefetch:
        return Prefetch(
            lambda: self._make(order),
            f"round {order.number + 1}: synthesis beside learning failed, "
            "checkpoints remain (resume=RUN_DIR)",
        )

    def _make(self, order: Order) -> None:
        """Write the traffic of an order into the memory's folder."""
        traffic, errored = make_traffic(
            order,
            self.attacks,
            solvable=self.solvable,
            nominal=self.settings.nominal == "prior",
            batch=self.batch,
        )
        self.memory.write(order.number, traffic, errored)

    def state_dict(self) -> dict:
        """Curriculum, ladder, improvement and the order of the coming round; the checkpoint
        adds weights, the memory's index and generators."""
        coming = None
        if self._next is not None:
            coming = dict(vars(self._next))
            ego = coming.pop("ego")
            assert isinstance(ego, ActorEgo)
            coming["weights"] = {
                name: value.detach().cpu()
                for name, value in ego.network.weights().items()
            }
        return {
            "curriculum": self.curriculum.state_dict(),
            "ladder": self._ladder.state_dict(),
            "improvement": self.improve.state_dict(),
            "next": coming,
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        self.curriculum.load_state_dict(state["curriculum"])
        self._ladder.load_state_dict(state["ladder"])
        self.improve.load_state_dict(state["improvement"])
        self._next = None
        self._prefetch = None
        if state["next"] is not None:
            coming = dict(state["next"])
            ego = copy.deepcopy(self.ego)
            assert isinstance(ego, ActorEgo)
            ego.network.set_weights(coming.pop("weights"))
            self._next = Order(ego=ego, **coming)
