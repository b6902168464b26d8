"""The steps of a round of Algorithm 1, which `train.py` does in turn, and the state of
a run between them."""

import copy
import time
from dataclasses import dataclass

from torch import Tensor

from e2rl.learning.pretraining.driving import Episodes
from e2rl.learning.rounds.attack import (
    ATTACK,
    Order,
    Solvable,
    Synthesize,
    counted,
    make_traffic,
)
from e2rl.learning.rounds.improvement import Improvement
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
from e2rl.run.settings import configured, setting
from e2rl.traffic.pool import TrafficPool


@configured("learner/ppo_bc", "round")
@dataclass(frozen=True)
class RoundSettings:
    """Settings `learner.round`."""

    scenes: int = setting(low=1)
    nominal: str = setting(choices=("prior", "log", "none"))
    memory: int = setting(low=0)
    prefetch: bool | None = setting(optional=True)


@dataclass
class RoundTraffic:
    """The traffic of a round: the pool, which of the ordered attacks its first K rows
    are (drawn [K] int64; the others were left out); attacked, contact: fractions of the
    attacks with an adversary, and that hit the ego; spent: seconds; errored: rows that
    could not be made."""

    pool: TrafficPool
    drawn: Tensor
    attacked: float
    contact: float
    spent: dict[str, float]
    errored: list[dict]


class Evolution:
    """The state of a run: curriculum, improvement (which holds the ego) and the memory
    of D'.

    choices: what the curriculum chose for the last round and what came of it
    (e2rl/learning/rounds/scheduler.py); errored: the last round's rollouts that errored, each
    with its reason.

    Args:
        synthesize: (ego, scene_index [S], eta [S], seed) -> {scene_index [S], states
            [S, T+1, N, 4], valid [S, T+1, N],
            adversaries [S, N] bool, contact [S] bool}: closed-loop traffic against that
            ego; contact: it was hit. Rows that cannot be made are left out, and
            `errored` {position in S: why} names them.
        solvable: traffic -> bool [S]: the rows that enter D'; None: all.
        memory: None: in a temporary folder.
        batch: scenes that are synthesized at once.
    """

    def __init__(
        self,
        curriculum: CurriculumScheduler,
        improve: Improvement,
        synthesize: Synthesize,
        settings: RoundSettings,
        seed: int = 0,
        solvable: Solvable | None = None,
        memory: Memory | None = None,
        batch: int = 64,
    ) -> None:
        self.curriculum = curriculum
        self.improve = improve
        self.synthesize = synthesize
        self.settings = settings
        self.seed = seed
        self.solvable = solvable
        self.memory = memory or Memory(None, settings.memory)
        self.batch = batch
        self.episodes: Episodes | None = None
        self.choices: list[Choice] = []
        self.errored: list[dict] = []
        self._next: Order | None = None  # of the coming round, if fixed already
        self._prefetch: Prefetch | None = None  # what makes it, if begun already

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
            spent = {
                "synthesize": work.wait(),
                "waiting": time.perf_counter() - begin,
            }
        else:
            self._make(order)
            spent = {"synthesize": time.perf_counter() - begin}
        newest = self.memory.take(order.number)
        pool = self.memory.pool()
        if self.settings.nominal == "log" or not len(pool):
            pool = pool + TrafficPool.recorded(order.scenes)  # the pool is never empty
        return RoundTraffic(
            pool,
            newest.traffic["entered"].nonzero()[:, 0],
            attacked=newest.traffic["attacked"].item(),
            contact=newest.traffic["contact"].item(),
            spent=spent,
            errored=newest.errored,
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
        """Improve the ego in the traffic of the round; returns the metrics of learning."""
        begin = time.perf_counter()
        learned, self.episodes = self.improve(attack.pool, self.curriculum)
        attack.spent["improve"] = time.perf_counter() - begin
        timed = ("collect", "steps_per_second")
        attack.spent |= {name: learned.pop(name) for name in timed if name in learned}
        return learned

    def move_on(
        self, order: Order, attack: RoundTraffic, learned: dict[str, float]
    ) -> dict[str, float]:
        """Move the curriculum by what became of the attacks; returns all metrics of the
        round, named by group (train/, curriculum/, synthesizer/, time/)."""
        curriculum = self.curriculum
        episodes = self.episodes
        state = self.curriculum.summary()
        assert episodes is not None
        outcomes = outcomes_of(
            order.eta, drawn=attack.drawn, row=episodes.row, failed=episodes.failed
        )
        curriculum.update(
            episodes.scene_index,
            episodes.failed,
            episodes.adversarial,
            episodes.survivable,
        )
        curriculum.leave_out(order.scenes[outcomes.left_out])
        self.choices = tally(order.number, outcomes)
        curriculum.advance(attack.contact)
        not_made = sum(entry["during"] == ATTACK for entry in attack.errored)
        attacked = {
            "scenes": float(len(order.scenes)),
            "eta": order.eta.mean().item(),
            "left_out": float(outcomes.left_out.sum() - not_made),
            "memory_rows": float(self.memory.rows),
            **counted(attack.errored),
            "attacked": attack.attacked,
            "contact": attack.contact,
        }
        self.errored = attack.errored
        groups = {
            "curriculum": state,
            "train": learned,
            "synthesizer": attacked,
            "time": attack.spent,
        }
        return {
            f"{group}/{name}": value
            for group, values in groups.items()
            for name, value in values.items()
        }

    # --- their parts

    def _order(self, number: int) -> Order:
        """What is to be synthesized for a round, as the curriculum and the ego are now."""
        scenes = self.curriculum.draw(self.settings.scenes)
        ego = self.ego
        if self.settings.prefetch:  # learning changes weights in place
            ego = copy.deepcopy(ego)
        return Order(
            number,
            scenes,
            eta=self.curriculum.etas(scenes),
            seed=self.seed * 1_000_003 + number,
            ego=ego,
        )

    def _begin(self, order: Order) -> Prefetch:
        name = f"round {order.number + 1}: synthesis beside learning failed, checkpoints remain (resume=RUN_DIR)"
        return Prefetch(lambda: self._make(order), name)

    def _make(self, order: Order) -> None:
        """Write the traffic of an order into the memory's folder."""
        traffic, errored = make_traffic(
            order,
            self.synthesize,
            solvable=self.solvable,
            nominal=self.settings.nominal == "prior",
            batch=self.batch,
        )
        self.memory.write(order.number, traffic, errored)

    def state_dict(self) -> dict:
        """Curriculum, improvement and the order of the coming round; the checkpoint
        adds weights, the memory's index and generators."""
        state = {
            "curriculum": self.curriculum.state_dict(),
            "improvement": self.improve.state_dict(),
            "next": None,
        }
        if self._next is not None:
            order = self._next
            ego = self._next.ego
            assert isinstance(ego, ActorEgo)
            weights = {
                name: value.detach().cpu()
                for name, value in ego.network.weights().items()
            }
            given = {
                name: getattr(order, name)
                for name in ("number", "scenes", "eta", "seed")
            }
            state["next"] = given | {"weights": weights}
        return state

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        self.curriculum.load_state_dict(state["curriculum"])
        self.improve.load_state_dict(state["improvement"])
        self._next = self._prefetch = None
        if state["next"] is not None:
            given = dict(state["next"])
            ego = copy.deepcopy(self.ego)
            assert isinstance(ego, ActorEgo)
            ego.network.set_weights(given.pop("weights"))
            self._next = Order(ego=ego, **given)
