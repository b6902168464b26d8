"""What a planner does wrong in a few scenes, before a long run is spent on it.

It drives there for two seconds among recorded traffic, and is asked again about the
moments that it was asked about: all scenes together, and each alone.
"""

import ctypes
import gc
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from resource import getpagesize
from time import perf_counter
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from e2rl.evaluation.finding import Finding
from e2rl.planners.ego import PLAN_STEPS, Ego, track
from e2rl.planners.ego_errors import NotFinite, WrongPlan
from e2rl.planners.ego_policy import ask, from_outside
from e2rl.planners.misreadings import MISREADINGS, misfit, misreading
from e2rl.planners.plausibility import action_faults, checked_answer, plan_faults
from e2rl.run.errors import InputError
from e2rl.scenes.reader_code import failed_line
from e2rl.scenes.recording import DT
from e2rl.scenes.scene import SceneSet
from e2rl.sim import dynamics
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.sim.world import AGENT_KEYS, World, without_future
from e2rl.traffic.grouping import take_rows

SCENES = 3  # that are driven
STEPS = 20  # in each of them, or two plans
LONGEST = 4.0  # s of a drive
PATIENCE = 30.0  # s until an answer that does not come is given up
AGAIN = 0.3  # s of the answers that are asked for again
LATE = 4.0  # s of asking again, after which no more is looked at
ROUNDS = 5  # of these, while memory is watched
GROWTH = 0.25  # MB in each round that is a leak
SAME = 1e-3  # m, rad, m/s between equal answers
ALIKE = 0.05  # between answers in batches of other sizes, but for rounding
SECOND = 10  # steps of a plan that are compared with the bounds
BEYOND = 0.2  # fraction of them beyond the bounds that is too large
FAR_BEYOND = 3.0  # times the bounds: an action of another unit
MOVES = 2.0  # m/s
STANDS = 0.5  # m/s
SHAPES = {"plan": (PLAN_STEPS, 4), "act": (2,)}  # of a scene's answers
MEMORY = Path("/proc/self/statm")


def telling_scenes(scenes: SceneSet) -> SceneSet:
    """Returns SCENES scenes, or all, at different places if there are: those in which
    an ego is fast, and drives across the axes, so that another frame shows."""
    start = scenes.scenes["start"][:, 0]
    order = (start[:, 3] * start[:, 2].sin().abs()).argsort(descending=True).tolist()
    first_there = {scenes.location[scene]: scene for scene in reversed(order)}
    chosen = sorted(
        order, key=lambda scene: first_there[scenes.location[scene]] != scene
    )
    return scenes.chosen(chosen[:SCENES])


class NoAnswer(BaseException):
    """A planner that does not answer: no Exception, which its own code might catch."""


@contextmanager
def patience() -> Iterator[None]:
    """Raises NoAnswer where what is within takes longer than PATIENCE, in Python's code
    or in a call of the system; what hangs in compiled code hangs."""

    def give_up(*_: Any) -> None:
        raise NoAnswer(f"gives no answer within {PATIENCE:.0f} s")

    former = signal.signal(signal.SIGALRM, give_up)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, former)


class WatchedWorld(World):
    """A World that knows what a planner changed in the copy that it was shown."""

    def shown(self, scene: Any = None) -> World:
        """Returns `World.shown`, and remembers it."""
        self.copy = super().shown(scene)
        self.before = {key: value.clone() for key, value in tensors_of(self.copy)}
        return self.copy

    def changed(self) -> set[str]:
        """Returns the names of the tensors that are other than they were shown."""
        if not hasattr(self, "copy"):
            return set()
        present = tensors_of(self.copy)
        return {key for key, value in present if not value.equal(self.before[key])}


def tensors_of(world: World) -> Iterator[tuple[str, Tensor]]:
    """Yields the tensors of a World and of its scene, with their names."""
    for key in AGENT_KEYS:
        yield f"world.{key}", getattr(world, key)
    for key, value in world.scene.items():
        yield f"world.scene[{key!r}]", value


@dataclass
class Moment:
    """A step at which an ego was asked.

    Args:
        world: of B scenes.
        observation: [B, D], for `act`.
        plan: [B, 1 + PLAN_STEPS, 4] of the last plan, for `act`.
        answers: its plan [B, PLAN_STEPS, 4] where it was due, and its action [B, 2]
            where it acts, by method.
        seconds: that an answer took.
    """

    world: World
    observation: Tensor
    plan: Tensor
    answers: dict[str, Tensor]
    seconds: float


class PlannerCheck:
    """Asks a planner, and says what is wrong with its answers.

    Args:
        build: makes an instance of the planner.
        scenes: that are driven.
        sim: settings of the simulator.
        device: of the simulation.
    """

    def __init__(
        self,
        build: Callable[[], Ego],
        scenes: SceneSet,
        *,
        sim: SimSettings,
        device: str = "cpu",
    ) -> None:
        self.build = build
        self.ego = build()
        self.scenes = scenes
        self.sim = sim
        self.device = device
        self.acts = type(self.ego).act is not Ego.act
        self.plans = type(self.ego).plan is not Ego.plan
        self.moments: list[Moment] = []
        self.changed: set[str] = set()
        self.off_road = torch.zeros(len(scenes), dtype=torch.bool)
        self.speed = torch.zeros(len(scenes))
        self.repeatable = False
        self._not_finite = ""
        self._visible: Any = None
        self._planned = torch.zeros(0)

    def findings(self) -> Iterator[Finding]:
        """Yields a line for every property of the planner."""
        if self.ego.replays_log:
            yield Finding("answers", None, "follows the recording: it is not asked")
            return
        answers = self._answers()
        yield answers
        if not self.moments:
            return
        frame = self._frame()
        yield frame
        yield self._bounds()
        yield self._time()
        if from_outside(self.ego):
            yield self._inputs()
        begin = perf_counter()
        for about, look in (
            ("repeats", self._repeats),
            ("rows", self._rows),
            ("memory", self._memory),
        ):
            if perf_counter() - begin > LATE:
                yield Finding(about, None, "not looked at: answers take too long")
                continue
            try:
                yield look()
            except (Exception, NoAnswer) as error:  # outside code raises anything
                yield Finding(about, False, f"asked again it {self._raised(error)}")
        if answers.fine and frame.fine:
            yield self._motion()

    # --- asking

    def _answer(
        self, ego: Ego, method: str, world: World, inputs: tuple[Tensor, ...] = ()
    ) -> Tensor:
        """Returns what `plan` or `act` of an ego answers; what is not finite is noted,
        and replaced."""
        watched = WatchedWorld(**vars(world))
        with patience():
            answer = ask(ego, method, watched, inputs=inputs, scene=self._visible)
        self.changed |= watched.changed()
        shape = (len(world.step), *SHAPES[method])
        try:
            checked_answer(answer, ego, method=method, shape=shape, begins=True)
        except NotFinite:
            bad = ~answer.isfinite().flatten(1).all(1)
            place = f"step {int(world.step[0])} of {self._names(bad)}"
            if not self._not_finite:
                self._not_finite = f"{method} is NaN or infinite, {place}"
            usual = Ego.plan(ego, world) if method == "plan" else answer.nan_to_num()
            answer = torch.where(answer.isfinite(), answer, usual.to(answer))
        return answer.to(world.states)

    def _begin(self, ego: Ego, world: World) -> None:
        """Resets an ego for the scenes of a world."""
        self._visible = without_future(world.scene) if from_outside(ego) else None
        with patience():
            ask(ego, "reset", world, scene=self._visible)

    def _again(self, ego: Ego, rows: Sequence[int] | None = None) -> list[Tensor]:
        """Returns the answers of an ego to the first moments, from a reset on, all that
        take AGAIN; rows: of their batch, by default all."""
        numbers = range(len(self.scenes)) if rows is None else rows
        index = torch.tensor(numbers, device=self.device)
        answers = []
        seconds = 0.0
        for position, moment in enumerate(self.moments):
            seconds += moment.seconds
            if position and seconds > AGAIN:
                break
            world = take_rows(moment.world, index)
            if position == 0:
                self._begin(ego, world)
            inputs = {
                "plan": (),
                "act": (moment.observation[index], moment.plan[index]),
            }
            for method in moment.answers:
                answers.append(self._answer(ego, method, world, inputs[method]))
        return answers

    def _first(self) -> list[Tensor]:
        """Returns the answers of the drive, in their order."""
        return [answer for moment in self.moments for answer in moment.answers.values()]

    def _names(self, rows: Tensor) -> str:
        """Returns the ids of the scenes where rows [B] is true."""
        return ", ".join(
            self.scenes.scene_id[row] for row in rows.nonzero()[:, 0].tolist()
        )

    def _raised(self, error: Exception | NoAnswer) -> str:
        """Returns in words that the planner raised, or does not answer, and where."""
        reason = str(error).partition("\n")[0]
        if isinstance(error, WrongPlan | InputError):
            return reason
        if not isinstance(error, NoAnswer):
            reason = f"raises {type(error).__name__}: {reason}"
        line = failed_line(type(self.ego), error.__traceback__)
        return f"{reason}{line and f' at {line}'}"

    # --- what is looked at

    def _answers(self) -> Finding:
        """Drives, and says whether all answers are finite and of the right shape."""
        try:
            self._drive()
        except (Exception, NoAnswer) as error:  # outside code raises anything
            text = f"{self._raised(error)}, step {len(self.moments)}"
            return Finding("answers", False, text, "such rollouts count as failures")
        if self._not_finite:
            mend = "look for a division, a root, or nobody near"
            return Finding("answers", False, self._not_finite, mend)
        answers = self._first()
        shapes = dict.fromkeys(str(list(answer.shape)) for answer in answers)
        text = f"{len(answers)}, {' and '.join(shapes)}, all finite"
        return Finding("answers", True, text)

    def _drive(self) -> None:
        """Drives as the planner says; along the recording where its first plan is of
        another frame, so that later ones still begin near a route."""
        count = len(self.scenes)
        settings = replace(
            self.sim, end_on_contact=False, end_off_road=False, end_when_gone=False
        )
        env = DrivingEnv(
            self.scenes,
            settings,
            count,
            device=self.device,
            agents=True,
            observed=self.acts,
        )
        index = TensorDict({"scene_index": torch.arange(count)[:, None]}, [count])
        data = env.reset(index)
        bounds = env.action_spec.space
        recorded = self.scenes.scenes["logged"][:, :, 0].to(self.device)
        other_frame = False
        begin = perf_counter()
        for step in range(min(max(STEPS, self.ego.replan_every + 1), env.horizon)):
            moment = self._moment(env.world(), data["observation"], step)
            self.moments.append(moment)
            if step == 0:
                other_frame = self._frame().fine is False
            state = moment.world.states[:, 0]
            if other_frame:
                action = track(state, recorded[:, step], recorded[:, step + 1])
            elif self.acts:
                action = moment.answers["act"]
            else:
                action = self.ego.act(moment.world, moment.observation, moment.plan)
            data["action"] = action.nan_to_num().clamp(bounds.low, bounds.high)
            data = env.step(data)["next"]
            self.off_road |= data["metrics", "off_road"][:, 0].cpu()
            if perf_counter() - begin > LONGEST:
                break
        self.speed = env.world().states[:, 0, 3].cpu()

    def _moment(self, world: World, observation: Tensor, step: int) -> Moment:
        """Returns a step of the drive, with the planner's answers."""
        begin = perf_counter()
        answers = {}
        age = step % self.ego.replan_every
        if step == 0:
            self._begin(self.ego, world)
        if age == 0:
            answers["plan"] = self._answer(self.ego, "plan", world)
            self._planned = torch.cat([world.states[:, :1], answers["plan"]], 1)
        steps = torch.arange(1 + PLAN_STEPS, device=self.device)
        index = (age + steps).clamp(max=PLAN_STEPS)
        plan = self._planned[:, index]
        if self.acts:
            answers["act"] = self._answer(self.ego, "act", world, (observation, plan))
        return Moment(world, observation, plan, answers, perf_counter() - begin)

    def _frame(self) -> Finding:
        """Says whether plans begin at the ego; if not, of what other frame they are."""
        due = [moment for moment in self.moments if "plan" in moment.answers]
        states = torch.stack([moment.world.states[:, 0] for moment in due])
        plans = torch.stack([moment.answers["plan"] for moment in due])
        if other := misreading(states, plans):
            return Finding("frame", False, f"plans are {other}", MISREADINGS[other][1])
        faults = [*plan_faults(states.flatten(0, 1), plans.flatten(0, 1))]
        for moment in self.moments if self.acts else ():
            state = moment.world.states[:, 0]
            faults += action_faults(state, moment.plan[:, 1:], moment.answers["act"])
        for wrong, text in faults:
            if bool(wrong.any()):
                mend = "states are of world.states' frame, in m, rad, m/s"
                return Finding("frame", False, text, mend)
        off = float(misfit(states, plans).amax())
        return Finding(
            "frame", True, f"plans begin at the ego ({off:.2f} of the tolerance)"
        )

    def _bounds(self) -> Finding:
        """Says how often answers ask for more than the simulator's bounds."""
        sim = self.sim
        low = torch.tensor([-sim.max_braking, -sim.max_yaw_rate])
        high = torch.tensor([sim.max_acceleration, sim.max_yaw_rate])
        if self.acts:
            acts = [moment.answers["act"] for moment in self.moments]
            actions = torch.stack(acts).cpu()
        else:
            plans = [
                moment.plan[:, : SECOND + 1]
                for moment in self.moments
                if "plan" in moment.answers
            ]
            actions = dynamics.inverse(torch.stack(plans)).cpu()
        beyond = ((actions < low - SAME) | (actions > high + SAME)).any(-1)
        share = float(beyond.double().mean())
        most = actions.abs().flatten(0, -2).amax(0).tolist()
        text = (
            f"up to {most[0]:.1f} m/s^2 and {most[1]:.2f} rad/s; beyond the bounds in "
            f"{100 * share:.0f}% of steps"
        )
        if share <= BEYOND:
            return Finding("bounds", True, text)
        far = self.acts and bool((actions.abs() > FAR_BEYOND * high).any())
        mend = "they are clipped: give m/s^2 and rad/s, within conf/sim/default.yaml"
        return Finding("bounds", False if far else None, text, mend)

    def _time(self) -> Finding:
        """Says how long an answer takes a scene; those after the first, which warms up."""
        name = "plan" if self.plans else "act"
        interval = self.ego.replan_every if self.plans else 1
        first, *later = [
            1000 * moment.seconds / len(self.scenes)
            for moment in self.moments
            if name in moment.answers
        ]
        mean = sum(later) / len(later) if later else first
        rollout = mean * self.scenes.steps / interval / 1000
        text = (
            f"{mean:.1f} ms a {name} and scene, {max(later, default=first):.1f} at worst "
            f"({first:.1f} the first): {rollout:.2f} s a rollout"
        )
        if mean <= 1000 * DT * interval:
            return Finding("time", True, text)
        mend = "raise ego.replan_every, plan all scenes of a batch at once, or faster"
        return Finding("time", False, f"{text}, slower than it drives", mend)

    def _inputs(self) -> Finding:
        """Says whether the planner changed what it was shown."""
        if not self.changed:
            return Finding("inputs", True, "are left as they were")
        names = ", ".join(sorted(self.changed)[:3])
        mend = "clone before you write; it would read its own changes later"
        return Finding("inputs", False, f"it changes {names} in place", mend)

    def _repeats(self) -> Finding:
        """Says whether the same moments after a reset get the same answers."""
        difference = largest(self._again(self.ego), self._first())
        self.repeatable = difference <= SAME
        if self.repeatable:
            return Finding("repeats", True, "the same answers after a reset")
        fresh = largest(self._again(self.build()), self._first())
        if fresh <= SAME:
            text = (
                f"remembers what was before a reset: answers differ by {difference:.2g}"
            )
            return Finding("repeats", False, text, "clear its memory in reset(world)")
        text = (
            f"is random: the same moments get answers that differ by {difference:.2g}"
        )
        mend = "draw from a torch.Generator that reset(world) seeds"
        return Finding("repeats", False, text, mend)

    def _rows(self) -> Finding:
        """Says whether a scene alone gets the same answers as in the batch."""
        if not self.repeatable:
            return Finding("rows", None, "not looked at: answers do not repeat")
        together = self._first()
        for row, name in enumerate(self.scenes.scene_id):
            alone = self._again(self.ego, [row])
            difference = largest(alone, [answer[[row]] for answer in together])
            if difference > ALIKE:
                text = f"{name} alone differs by {difference:.2g} from it in a batch"
                mend = "let no mean, maximum or any() reach over the first dimension"
                return Finding("rows", False, text, mend)
        return Finding("rows", True, "the same answers for a scene alone")

    def _memory(self) -> Finding:
        """Says whether memory grows while the planner is asked the same again."""
        if not MEMORY.exists():
            return Finding("memory", None, "is not known on this system")
        sizes = []
        for _ in range(ROUNDS):
            count = len(self._again(self.ego))
            sizes.append(resident_megabytes())
        steps = [
            after - before for before, after in zip(sizes, sizes[1:], strict=False)
        ]
        growth = sum(steps) / len(steps)
        if min(steps) < GROWTH:
            return Finding("memory", True, f"steady over {ROUNDS * count} answers")
        text = f"grows by {growth:.1f} MB every {count} answers"
        mend = "keep no worlds or plans; clear lists in reset(world)"
        return Finding("memory", False, text, mend)

    def _motion(self) -> Finding:
        """Says whether the ego drives, and on the road."""
        seconds = DT * len(self.moments)
        recorded = self.scenes.scenes["logged"][:, len(self.moments), 0, 3]
        start = self.moments[0].world.states[:, 0, 3].cpu()
        if bool(
            ((self.speed < STANDS) & (torch.minimum(start, recorded) > MOVES)).all()
        ):
            text = f"it stands in all scenes after {seconds:.1f} s, the recorded ones drive"
            return Finding("motion", False, text, "look at the speeds that it plans")
        if bool(self.off_road.any()):
            fine = False if bool(self.off_road.all()) else None
            text = f"leaves the road within {seconds:.1f} s in {self._names(self.off_road)}"
            return Finding(
                "motion", fine, text, "does it follow mission_of(world.scene)?"
            )
        speeds = f"{float(start.mean()):.1f} to {float(self.speed.mean()):.1f} m/s"
        return Finding(
            "motion", True, f"on the road for {seconds:.1f} s, from {speeds}"
        )


def resident_megabytes() -> float:
    """Returns the memory of this process, without what is free in its heap: new tensors
    would fill that first."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc
    if trim is not None:
        trim(0)
    return int(MEMORY.read_text().split()[1]) * getpagesize() / 1e6


def largest(first: Sequence[Tensor], second: Sequence[Tensor]) -> float:
    """Returns the largest difference of answers, as far as both go."""
    return max(
        float((a.double() - b.double()).abs().max())
        for a, b in zip(first, second, strict=False)
    )
