"""Algorithm 1: rounds of drawing scenes, attacking the current ego in them, improving it, and moving the curriculum."""

import copy
import time
from dataclasses import dataclass, field

import torch
from torch import Tensor

from e2rl.learning.attack import ATTACK, Order, Solvable, Synthesize, counted, ended_of, make_traffic
from e2rl.learning.driving import Episodes
from e2rl.learning.improvement import Improvement
from e2rl.learning.memory import Memory
from e2rl.learning.prefetch import Ahead, AheadElsewhere
from e2rl.learning.scheduler import Choice, CurriculumScheduler, outcomes_of, tally
from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego import Ego
from e2rl.run.errors import InputError
from e2rl.run.processes import RayWorkers
from e2rl.run.settings import check_choice, check_range
from e2rl.traffic.pool import TrafficPool

NOMINAL, TRAFFIC, AGAINST = ("prior", "log", "none"), ("replay", "live"), ("current", "start")
NOISES = 16  # rows per scene in live traffic, each with its own noise


@dataclass(frozen=True)
class RoundSettings:
    """Fields: `round` in conf/learner/*.yaml."""

    scenes: int = 48
    nominal: str = "prior"
    traffic: str = "replay"
    against: str = "current"
    memory: int = 4096
    fresh: float = 3.0
    ahead: bool = False
    second: str | None = None
    second_share: float = 0.5

    def __post_init__(self) -> None:
        check_choice("learner.round.nominal", self.nominal, NOMINAL)
        check_choice("learner.round.traffic", self.traffic, TRAFFIC)
        check_choice("learner.round.against", self.against, AGAINST)
        check_range("learner.round.fresh", self.fresh, 1)
        check_range("learner.round.second_share", self.second_share, 0, 1)
        if self.second and self.traffic == "live":
            raise InputError("learner.round.second: live traffic is of one method; set learner.round.traffic=replay")
        if self.against == "start" and self.traffic == "live":
            raise InputError("learner.round.against=start: live traffic meets the learning policy; set it to current")


@dataclass
class Attack:
    """The traffic of a round: the pool, which of the ordered attacks its first K rows are (drawn [K] int64; the others
    were left out), and metrics; contact: the attacked ego's contact rate, None if unknown before the episodes are
    driven; spent: seconds; ended: rows that could not be made."""

    pool: TrafficPool
    drawn: Tensor
    metrics: dict[str, float]
    spent: dict[str, float]
    contact: float | None = None
    ended: list[dict] = field(default_factory=list)


class Evolution:
    """The state of a run: curriculum, improvement (which holds the ego) and the memory of D'; choices: what the
    curriculum chose for the last round and what came of it, in rows (e2rl/learning/scheduler.py); ended: its
    rollouts that ended for an error of the planner or the traffic, each with its reason.

    synthesize(ego, scene_index [S], eta [S], seed) -> {scene_index [S], states [S, T+1, N, 4], valid [S, T+1, N],
    adversaries [S, N] bool, contact [S] bool}: closed-loop traffic against that ego; contact: it was hit. Rows that
    cannot be made are left out, and ended {position in S: why} names them. Of a curriculum that chooses causal
    templates it also takes template [S].
    solvable(traffic) -> Solved: rows that enter D', and evasions (None: all, and none). memory: None: in a temporary
    folder. batch: scenes that are synthesized at once; workers: that do it (None: a process here).

    With `settings.ahead`, scenes, intensities and ego of the next round's D' are fixed just before a round's learning,
    and it is made in other processes meanwhile. What the curriculum learns from a round then acts two rounds later.
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
        workers: RayWorkers | None = None,
    ) -> None:
        self.curriculum, self.improve, self.synthesize = curriculum, improve, synthesize
        self.settings, self.seed, self.solvable = settings, seed, solvable
        self.memory, self.batch, self.workers = memory or Memory(None, settings.memory), batch, workers
        self._start = copy.deepcopy(improve.ego) if settings.against == "start" else None
        self.episodes: Episodes | None = None
        self.choices: list[Choice] = []
        self.ended: list[dict] = []
        self._next: Order | None = None  # of the coming round, if fixed already
        self._ahead: Ahead | AheadElsewhere | None = None  # what makes it, if begun already

    @property
    def ego(self) -> Ego:
        """The current ego."""
        return self.improve.ego

    @property
    def round(self) -> int:
        """Rounds done."""
        return self.curriculum.round

    def run_round(self) -> dict[str, float]:
        """One round; returns its metrics, named by group (train/, curriculum/, synthesizer/, time/)."""
        order, self._next = self._next or self._order(self.round), None
        state = self.curriculum.summary()
        attack = self._live(order) if self.settings.traffic == "live" else self._stored(order)
        if self.settings.ahead:
            self._begin_next()
        begin = time.perf_counter()
        learned, self.episodes = self.improve(attack.pool, self.curriculum)
        spent = attack.spent | {"improve": time.perf_counter() - begin}
        spent |= {name: learned.pop(name) for name in ("collect", "pairs", "steps_per_second") if name in learned}
        self.curriculum.update(self.episodes.scene_index, self.episodes.failed, self.episodes.adversarial)
        outcomes = outcomes_of(order.eta, order.template, attack.drawn, self.episodes.row, self.episodes.failed)
        self.curriculum.observe(outcomes)
        self.curriculum.leave_out(order.scenes[outcomes.left_out])
        level = self.curriculum.level(order.eta)
        self.choices = tally(order.number, level, outcomes, self.curriculum.values())
        contact = learned.get("contact_adversarial") if attack.contact is None else attack.contact
        self.curriculum.advance(contact)
        attacked = {"scenes": float(len(order.scenes)), "eta": order.eta.mean().item()}
        lost = sum(entry["during"] == ATTACK for entry in attack.ended)
        attacked |= {"left_out": float(outcomes.left_out.sum() - lost), "memory_rows": float(self.memory.rows)}
        attacked |= counted(attack.ended)
        self.ended = [*attack.ended, *({"round": order.number, **entry} for entry in self.improve.ended)]
        attacked |= {"fresh_draws": attack.pool.fresh[self.episodes.row].float().mean().item(), **attack.metrics}
        attacked |= {} if contact is None else {"contact": contact}
        groups = {"curriculum": state, "train": learned, "synthesizer": attacked, "time": spent}
        return {f"{group}/{name}": value for group, values in groups.items() for name, value in values.items()}

    def _order(self, number: int) -> Order:
        """What is to be synthesized for a round, as the curriculum and the ego are now."""
        scenes = self.curriculum.draw(self.settings.scenes)
        ego = self._start or self.ego
        ego = copy.deepcopy(ego) if self.settings.ahead else ego  # learning changes weights in place
        return Order(number, scenes, *self.curriculum.choices(scenes), self.seed * 1_000_003 + number, ego)

    def _begin_next(self) -> None:
        """Fix the next round's order; begin on it if the run has such a round."""
        self._next = self._order(self.round + 1)
        if self.round + 1 < self.curriculum.rounds:
            self._ahead = self._begin(self._next)

    def _begin(self, order: Order) -> Ahead | AheadElsewhere:
        name = f"round {order.number + 1}: synthesis beside learning failed, checkpoints remain (resume=RUN_DIR)"
        if self.workers is None:
            return Ahead(lambda: self._make(order), name)
        self.workers.connect()
        return AheadElsewhere(lambda: self._make(order), name)

    def _make(self, order: Order) -> None:
        """Write the traffic of an order into the memory's folder."""
        how = (self.settings.nominal == "prior", self.batch, self.workers or 1)
        traffic = make_traffic(order, self.synthesize, self.solvable, *how)
        self.memory.write(order.number, traffic)

    def _stored(self, order: Order) -> Attack:
        """D' of an order joined with the memory, and nominal traffic."""
        begin = time.perf_counter()
        if self.settings.ahead:
            at_work, self._ahead = self._ahead or self._begin(order), None
            spent = {"synthesize": at_work.wait(), "waiting": time.perf_counter() - begin}
        else:
            self._make(order)
            spent = {"synthesize": time.perf_counter() - begin}
        traffic = self.memory.take(order.number)
        pool = self.memory.pool(self.settings.fresh)
        if self.settings.nominal == "log" or not len(pool):  # without nominal traffic the pool may be empty
            pool = pool + TrafficPool.recorded(order.scenes)
        metrics, drawn = {"attacked": traffic["attacked"].item()}, traffic["kept"].nonzero()[:, 0]
        return Attack(pool, drawn, metrics, spent, traffic["contact"].item(), ended_of(traffic))

    def _live(self, order: Order) -> Attack:
        """Rows whose traffic is replanned against the learning ego, attacked and nominal."""
        index, eta, template = (each.repeat(NOISES) for each in (order.scenes, order.eta, order.template))
        noise = index + (order.seed * NOISES + torch.arange(NOISES).repeat_interleave(len(order.scenes))) * 1_000_003
        pool = TrafficPool.live(index, eta, noise, template)
        if self.settings.nominal == "prior":
            pool = pool + TrafficPool.live(index, torch.zeros_like(eta), noise)
        elif self.settings.nominal == "log":
            pool = pool + TrafficPool.recorded(order.scenes)
        return Attack(pool, torch.arange(len(order.scenes)).repeat(NOISES), {}, {"synthesize": 0.0})

    def state_dict(self) -> dict:
        """Curriculum, improvement and the order of the coming round; the checkpoint adds weights, the memory's index
        and generators."""
        state = {"curriculum": self.curriculum.state_dict(), "improvement": self.improve.state_dict(), "next": None}
        if self._next is not None:
            order, ego = self._next, self._next.ego
            assert isinstance(ego, ActorEgo)
            weights = {name: value.detach().cpu() for name, value in ego.network.weights().items()}
            given = {name: getattr(order, name) for name in ("number", "scenes", "eta", "template", "seed")}
            state["next"] = given | {"weights": weights}
        return state

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        self.curriculum.load_state_dict(state["curriculum"])
        self.improve.load_state_dict(state["improvement"])
        self._next = self._ahead = None
        if state["next"] is not None:
            given, ego = dict(state["next"]), copy.deepcopy(self.ego)
            assert isinstance(ego, ActorEgo)
            ego.network.set_weights(given.pop("weights"))
            self._next = Order(ego=ego, **given)
