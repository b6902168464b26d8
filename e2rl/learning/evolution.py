"""The steps of a round of Algorithm 1, which `train.py` does in turn, and the state of
a run between them."""

import copy
import time
from dataclasses import dataclass, field

import torch
from torch import Tensor

from e2rl.learning.attack import (
    ATTACK,
    Order,
    Solvable,
    Synthesize,
    counted,
    make_traffic,
)
from e2rl.learning.driving import Episodes
from e2rl.learning.improvement import Improvement
from e2rl.learning.memory import Memory
from e2rl.learning.prefetch import Prefetch
from e2rl.learning.scheduler import Choice, CurriculumScheduler, outcomes_of, tally
from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego import Ego
from e2rl.run.errors import InputError
from e2rl.run.ray_workers import RayWorkers
from e2rl.run.settings import configured, setting
from e2rl.traffic.pool import TrafficPool

NOISES = 16  # rows per scene in live traffic, each with its own noise


@configured("learner/ppo_bc", "round")
@dataclass(frozen=True)
class RoundSettings:
    """Settings `learner.round`."""

    scenes: int = setting(low=1)
    nominal: str = setting(choices=("prior", "log", "none"))
    traffic: str = setting(choices=("replay", "live"))
    against: str = setting(choices=("current", "start"))
    memory: int = setting(low=0)
    fresh: float = setting(low=1)
    prefetch: bool | None = setting(optional=True)
    second: str | None = setting(optional=True)
    second_fraction: float = setting(low=0, high=1)

    def __post_init__(self) -> None:
        if self.second and self.traffic == "live":
            raise InputError(
                "learner.round.second: live traffic is of one method; set learner.round.traffic=replay"
            )
        if self.against == "start" and self.traffic == "live":
            raise InputError(
                "learner.round.against=start: live traffic meets the learning policy; set it to current"
            )


@dataclass
class RoundTraffic:
    """The traffic of a round: the pool, which of the ordered attacks its first K rows
    are (drawn [K] int64; the others were left out), and metrics; contact: the attacked
    ego's contact rate, None if unknown before the episodes are driven; spent: seconds;
    errored: rows that could not be made."""

    pool: TrafficPool
    drawn: Tensor
    metrics: dict[str, float]
    spent: dict[str, float]
    contact: float | None = None
    errored: list[dict] = field(default_factory=list)


class Evolution:
    """The state of a run: curriculum, improvement (which holds the ego) and the memory
    of D'.

    choices: what the curriculum chose for the last round and what came of it
    (e2rl/learning/scheduler.py); errored: the last round's rollouts that errored, each
    with its reason.

    Args:
        synthesize: (ego, scene_index [S], eta [S], seed) -> {scene_index [S], states
            [S, T+1, N, 4], valid [S, T+1, N],
            adversaries [S, N] bool, contact [S] bool, owes [S] bool}: closed-loop traffic against that ego; contact: it
            was hit; owes: adversaries give way to it (left out: they do). Rows that cannot be made are left out, and
            `errored` {position in S: why} names them. A curriculum that chooses causal templates gives template [S],
            too.
        solvable: traffic -> Solved: the rows that enter D', and evasions; None: all,
            and none.
        memory: None: in a temporary folder.
        batch: scenes that are synthesized at once.
        workers: that do it; None: a process here.
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
        self.curriculum = curriculum
        self.improve = improve
        self.synthesize = synthesize
        self.settings = settings
        self.seed = seed
        self.solvable = solvable
        self.memory = memory or Memory(None, settings.memory)
        self.batch = batch
        self.workers = workers
        self._start = (
            copy.deepcopy(improve.ego) if settings.against == "start" else None
        )
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
        """Returns what is attacked: scenes, intensities and causal templates by the
        curriculum, and the current ego."""
        order = self._next or self._order(self.round)
        self._next = None
        return order

    def roll_out(self, order: Order) -> RoundTraffic:
        """Returns the attacks on the ordered ego, without those that no driver avoids,
        with remembered attacks and nominal traffic; of live traffic the rows alone,
        whose attacks are rolled out while the policy drives."""
        return (
            self._live(order)
            if self.settings.traffic == "live"
            else self._stored(order)
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
        timed = ("collect", "demonstrations", "steps_per_second")
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
        told = episodes.row, episodes.failed, episodes.survivable
        outcomes = outcomes_of(order.eta, order.template, attack.drawn, *told)
        contact = (
            learned.get("contact_adversarial")
            if attack.contact is None
            else attack.contact
        )
        curriculum.update(
            episodes.scene_index,
            episodes.failed,
            episodes.adversarial,
            episodes.survivable,
        )
        curriculum.observe(outcomes)
        curriculum.leave_out(order.scenes[outcomes.left_out])
        self.choices = tally(
            order.number,
            curriculum.level(order.eta),
            outcomes=outcomes,
            value=curriculum.values(),
        )
        curriculum.advance(contact)
        not_made = sum(entry["during"] == ATTACK for entry in attack.errored)
        attacked = {
            "scenes": float(len(order.scenes)),
            "eta": order.eta.mean().item(),
            "left_out": float(outcomes.left_out.sum() - not_made),
            "memory_rows": float(self.memory.rows),
            **counted(attack.errored),
            "fresh_draws": attack.pool.fresh[episodes.row].float().mean().item(),
            **attack.metrics,
        }
        attacked |= {} if contact is None else {"contact": contact}
        self.errored = [
            *attack.errored,
            *({"round": order.number, **entry} for entry in self.improve.errored),
        ]
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
        ego = self._start or self.ego
        ego = (
            copy.deepcopy(ego) if self.settings.prefetch else ego
        )  # learning changes weights in place
        return Order(
            number,
            scenes,
            *self.curriculum.choices(scenes),
            self.seed * 1_000_003 + number,
            ego,
        )

    def _begin(self, order: Order) -> Prefetch:
        name = f"round {order.number + 1}: synthesis beside learning failed, checkpoints remain (resume=RUN_DIR)"
        if self.workers is not None:
            self.workers.connect()
        return Prefetch(lambda: self._make(order), name, forked=self.workers is None)

    def _make(self, order: Order) -> None:
        """Write the traffic of an order into the memory's folder."""
        how = (self.settings.nominal == "prior", self.batch, self.workers or 1)
        self.memory.write(
            order.number, *make_traffic(order, self.synthesize, self.solvable, *how)
        )

    def _stored(self, order: Order) -> RoundTraffic:
        """D' of an order joined with the memory, and nominal traffic."""
        begin = time.perf_counter()
        if self.settings.prefetch:
            at_work = self._prefetch or self._begin(order)
            self._prefetch = None
            spent = {
                "synthesize": at_work.wait(),
                "waiting": time.perf_counter() - begin,
            }
        else:
            self._make(order)
            spent = {"synthesize": time.perf_counter() - begin}
        made = self.memory.take(order.number)
        pool = self.memory.pool(self.settings.fresh)
        if self.settings.nominal == "log" or not len(
            pool
        ):  # without nominal traffic the pool may be empty
            pool = pool + TrafficPool.recorded(order.scenes)
        metrics = {"attacked": made.traffic["attacked"].item()}
        drawn = made.traffic["entered"].nonzero()[:, 0]
        return RoundTraffic(
            pool,
            drawn,
            metrics=metrics,
            spent=spent,
            contact=made.traffic["contact"].item(),
            errored=made.errored,
        )

    def _live(self, order: Order) -> RoundTraffic:
        """Rows whose traffic is replanned against the learning ego, attacked and
        nominal."""
        index, eta, template = (
            each.repeat(NOISES) for each in (order.scenes, order.eta, order.template)
        )
        noise = (
            index
            + (
                order.seed * NOISES
                + torch.arange(NOISES).repeat_interleave(len(order.scenes))
            )
            * 1_000_003
        )
        pool = TrafficPool.live(index, eta, seed=noise, template=template)
        if self.settings.nominal == "prior":
            pool = pool + TrafficPool.live(index, torch.zeros_like(eta), seed=noise)
        elif self.settings.nominal == "log":
            pool = pool + TrafficPool.recorded(order.scenes)
        return RoundTraffic(
            pool,
            torch.arange(len(order.scenes)).repeat(NOISES),
            metrics={},
            spent={"synthesize": 0.0},
        )

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
                for name in ("number", "scenes", "eta", "template", "seed")
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
