"""One interface for all egos: planners, the learned actor, users' code.

A user's planner is a class and a YAML file in conf/ego with its `_target_` and
arguments (docs/how-to/planner.md, examples/). It overrides `plan`, and `act` tracks the
plan; or `act`, which maps observations to actions.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from e2rl.run.config import Extension
from e2rl.run.errors import InputError
from e2rl.run.settings import check_range
from e2rl.scenes.boxes import to_frame
from e2rl.scenes.recording import DT
from e2rl.sim import dynamics
from e2rl.sim.world import World, without_future

PLAN_STEPS = 50  # H: planned steps of DT
RETURN_TIME, RETURN_LENGTH = (
    0.7,
    1.5,
)  # s, m: a lateral error decays over max(RETURN_LENGTH, RETURN_TIME * v)
CATCH_UP = 1.0  # 1/s: rate at which a longitudinal error is corrected
FASTEST = (
    50.0  # m/s: a plan that is faster, in its speeds or from pose to pose, is nonsense
)
LARGEST = 100.0  # m/s^2, rad/s: so is a larger action
# A plan that begins farther away is in another frame, or of another time; some begin on
# a lane beside.
ALONG, ASIDE, TURNED = 2.0, 5.0, 1.0  # m, m, rad
CREEP = 0.5  # m/s below which a heading may be anything
JUMPS = f"a plan that is not finite, or jumps (above {FASTEST:g} m/s)"
STRAYS = (
    f"a plan that begins more than {ALONG:g} m ahead of, behind, {ASIDE:g} m beside or {TURNED:g} rad from where the "
    "ego will be 0.1 s from now: its states are of the scene's frame, the first of them 0.1 s ahead"
)
BACKWARDS = "a plan that goes backwards: egos do not reverse, and who reverses at the start comes to a halt"
WILD = f"an action that is not finite, or above {LARGEST:g}"
BY_EGO = "raised by the ego"  # note on what its code raises


class Ego(Extension):
    """Drives the ego of B scenes at once, by its plans, a pure function of the World,
    or by its actions.

    replan_every: steps between two plans (5 is 2 Hz, 1 every step), at most PLAN_STEPS;
    replays_log: the environment moves this ego along its recording
    (`SimSettings.replay_ego`) and ignores its actions; tuned: what `e2rl tune`
    searches, {argument: (low, high) or (low, high, "log")}.
    """

    replays_log = False
    tuned: ClassVar[Mapping[str, tuple]] = {}

    def __init__(self, replan_every: int = 5) -> None:
        check_range("ego.replan_every", replan_every, low=1, high=PLAN_STEPS)
        self.replan_every = replan_every

    def reset(self, world: World) -> None:  # noqa: B027 - most egos have no memory
        """Called before the first plan of new episodes (world.step 0). An ego with
        memory clears it here."""

    def __new__(cls, *args: Any, **settings: Any) -> "Ego":
        if cls.plan is Ego.plan and cls.act is Ego.act:
            raise TypeError(
                f"{cls.__name__} overrides neither plan nor act, so that it does not drive"
            )
        return super().__new__(cls)

    def plan(self, world: World) -> Tensor:
        """Planned states [B, PLAN_STEPS, 4] of the egos at steps 1.. from now, 0.1 s
        apart, without side effects.

        By default, for an ego that acts, its present velocity held.
        """
        ahead = DT * torch.arange(1, PLAN_STEPS + 1, device=world.states.device)
        return dynamics.constant_velocity(world.states[:, 0], ahead)

    def act(self, world: World, observation: Tensor, plan: Tensor) -> Tensor:
        """Action [B, 2] (acceleration [m/s^2], yaw rate [rad/s]) for the next step; by
        default it tracks the plan.

        observation [B, D]: the environment's; plan [B, 1 + PLAN_STEPS, 4]: states of
        the last plan, now and at the coming steps.
        """
        return track(world.states[:, 0], plan[:, 0], following=plan[:, 1])


def return_length(speed: Tensor) -> Tensor:
    """Metres over which a lateral error decays at speed [...] m/s."""
    return (RETURN_TIME * speed).clamp(min=RETURN_LENGTH)


def track(state: Tensor, planned: Tensor, following: Tensor) -> Tensor:
    """Action [..., 2] with which a vehicle at state [..., 4] tracks a plan: `planned`
    now, `following` one step later.

    Inverse dynamics to the following speed and heading, corrected by the deviation from
    the plan: a lateral error turns the target heading towards the plan, a longitudinal
    error changes the target speed. A plan that obeys the unicycle is tracked without
    error.
    """
    error = to_frame(state[..., :2], planned)
    heading = following[..., 2] - torch.atan(
        error[..., 1] / return_length(state[..., 3])
    )
    speed = (following[..., 3] - CATCH_UP * error[..., 0]).clamp(min=0)
    aimed = torch.cat([following[..., :2], torch.stack([heading, speed], -1)], -1)
    return dynamics.inverse(torch.stack([state, aimed], -2))[..., 0, :]


class RowsError(Exception):
    """Rollouts of a batch end; rows: why, by row of the batch, empty where it is not
    known which.

    The others of the batch are driven anew without them.
    """

    def __init__(self, message: str, rows: Mapping[int, str] | None = None) -> None:
        super().__init__(message)
        self.rows = dict(rows or {})


@contextmanager
def renumbered(rows: Tensor) -> Iterator[None]:
    """Lets a RowsError of rows [G] of a batch name them by their numbers in that batch."""
    try:
        yield
    except RowsError as error:
        numbers = rows.tolist()
        error.rows = {
            numbers[row]: why
            for row, why in error.rows.items()
            if 0 <= row < len(numbers)
        }
        raise


class PlannerError(RowsError):
    """A planner has no plan for scenes of its batch."""


class TrafficNotFinite(RowsError):
    """An ego was asked about vehicles whose states are NaN or infinite."""


class Undrivable(PlannerError):
    """A planner in this process asked for what no vehicle can drive."""


class PlannerExited(PlannerError):
    """A planner called sys.exit."""


class WrongPlan(PlannerError, InputError):
    """A planner returned something else than a tensor of the shape asked for; begins:
    at the start of its rollouts.

    Bad input where the run begins with it, else the end of these rollouts.
    """

    def __init__(self, message: str, begins: bool = False) -> None:
        super().__init__(message)
        self.begins = begins


class NotFinite(ArithmeticError):
    """An ego planned or acted NaN or infinite."""


def finite(values: Tensor, name: str) -> Tensor:
    """The plans or actions [B, ...] of an ego; raises NotFinite where one is not
    finite."""
    if not bool(values.isfinite().all()):
        raise NotFinite(f"the ego's {name} is NaN or infinite")
    return values


def drivable(now: Tensor, given: Tensor, known: Tensor | int = PLAN_STEPS) -> Tensor:
    """Bool [B]: the first `known` [B] states of given [B, H, 4] are finite and no
    faster than FASTEST, in their speeds and from pose to pose, beginning at states now
    [B, 4]."""
    moved = torch.cat([now[:, None, :2], given[..., :2]], 1).diff(dim=1).norm(dim=-1)
    fine = (
        (moved <= FASTEST * DT)
        & (given[..., 3].abs() <= FASTEST)
        & given.isfinite().all(-1)
    )
    counts = (
        torch.arange(given.shape[1], device=given.device)
        < torch.as_tensor(known, device=given.device)[..., None]
    )
    return (fine | ~counts).all(1)


def strays(now: Tensor, first: Tensor) -> Tensor:
    """Bool [B]: the first planned state [B, 4] is elsewhere than the ego at states now
    [B, 4] will be in a step."""
    due = dynamics.constant_velocity(now, torch.full_like(now[:, :1], DT))[:, 0]
    moves = torch.minimum(now[:, 3].abs(), first[:, 3].abs()) > CREEP
    turned = dynamics.wrap(first[:, 2] - due[:, 2]).abs() > TURNED
    away = to_frame(first[:, :2], due).abs() > torch.tensor(
        [ALONG, ASIDE], device=due.device
    )
    return away.any(-1) | (turned & moves)


def reverses(now: Tensor, planned: Tensor) -> Tensor:
    """Bool [B]: a plan [B, H, 4] of an ego at states now [B, 4], which does not
    reverse, begins against its heading."""
    moved = to_frame(planned[:, 1, :2], planned[:, 0])
    against = moved[:, 0] < -moved[:, 1].abs()
    return (now[:, 3] >= 0) & (against | (planned[:, 0, 3] < 0))


def checked(
    given: Any, shape: tuple[int, ...], ego: Ego, method: str, begins: bool
) -> Tensor:
    """Returns what `plan` or `act` of an ego returned.

    Args:
        given: what was returned.
        shape: that it should have.
        ego, method: who returned it.
        begins: it is the first answer of rollouts.

    Raises:
        WrongPlan: it is no tensor of floats of this shape.
        NotFinite: it is not finite.
    """
    floats = isinstance(given, Tensor) and given.is_floating_point()
    if not floats or tuple(given.shape) != shape:
        found = type(given).__name__
        mend = "; torch.as_tensor makes one of an array"
        if isinstance(given, Tensor):
            found = f"{given.dtype} {list(given.shape)}"
            mend = ""
        elif hasattr(given, "shape") and hasattr(given, "dtype"):
            found = f"{type(given).__module__.partition('.')[0]} {found} of {given.dtype} {list(given.shape)}"
        returned = f"{type(ego).__name__}.{method}: returns {found}"
        wanted = (
            f"expected a tensor of floats {list(shape)}{mend} (docs/how-to/planner.md)"
        )
        raise WrongPlan(f"{returned}, {wanted}", begins)
    return finite(given, "plan" if method == "plan" else "action")


def from_outside(ego: Ego) -> bool:
    """Whether the class of the ego is not e2rl's own."""
    return not type(ego).__module__.startswith("e2rl.")


def ask(
    ego: Ego,
    method: str,
    world: World,
    *given: Tensor,
    scene: TensorDictBase | None = None,
) -> Any:
    """What a method of the ego returns; one from outside the package is given copies,
    by `World.shown` of `scene`.

    Raises PlannerExited where it ends the program.
    """
    asked = getattr(ego, method)
    if from_outside(ego) and asked.__module__ != __name__:
        world = world.shown(scene)
        given = tuple(value.clone() for value in given)
    try:
        return asked(world, *given)
    except SystemExit as error:
        raise PlannerExited(f"it called sys.exit({error.code!r})") from error


@contextmanager
def answering(world: World) -> Iterator[None]:
    """Notes on what is raised within that it is the ego's, which is asked about a
    world.

    Raises TrafficNotFinite instead where the other vehicles of that world are NaN or
    infinite: no ego can answer then.
    """
    try:
        yield
    except Exception as error:
        known = world.states[:, 1:].isfinite().all(-1) | ~world.valid[:, 1:]
        if rows := (~known).any(1).nonzero()[:, 0].tolist():
            why = "a vehicle of the traffic is NaN or infinite"
            raise TrafficNotFinite(why, dict.fromkeys(rows, why)) from error
        error.add_note(BY_EGO)
        raise


class EgoPlanner(TensorDictModuleBase):
    """Writes the plan of an Ego in a DrivingEnv with `agents=True`: ("ego", "plan") [B,
    PLAN_STEPS, 4].

    Plans every `replan_every` steps; in between, the key holds the rest of the last
    plan, its last state held. Reads timestep, agents and, if present, the traffic's
    plan.
    """

    in_keys = ["timestep", "agents"]
    out_keys: list[str | tuple[str, str]] = [("ego", "plan")]

    def __init__(self, ego: Ego, env) -> None:
        """env: the DrivingEnv (or a TransformedEnv around it) in which the ego drives."""
        super().__init__()
        base = getattr(env, "base_env", env)
        self.ego = ego
        self.scene = base.scene
        self.bounds = base.action_spec.space
        start = self.scene["start"][:, :1]
        self._plan = torch.zeros_like(start).repeat(
            1, 1 + PLAN_STEPS, 1
        )  # the state at the time of planning first
        self._planned_at = torch.full(
            start.shape[:1], -PLAN_STEPS, device=start.device
        )  # step of planning
        self._shown: TensorDictBase | None = (
            None  # the scenes as a planner from outside sees them
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        world = World.of(tensordict, self.scene)
        with answering(world):
            tensordict["ego", "plan"] = self.plan(world)[:, 1:]
        return tensordict

    def plan(self, world: World) -> Tensor:
        """States [B, 1 + PLAN_STEPS, 4] now and at the coming steps of the last plan;
        replans where due."""
        if bool((world.step == 0).any()):
            self._shown = without_future(self.scene) if from_outside(self.ego) else None
            self._ask("reset", world)
        age = world.step - self._planned_at
        due = (age >= self.ego.replan_every) | (age < 0) | (world.step == 0)
        if bool(due.any()):
            now = world.states[:, 0]
            answer = self._ask("plan", world)
            begins = bool((world.step == 0).all())
            fresh = checked(
                answer,
                (len(now), PLAN_STEPS, 4),
                ego=self.ego,
                method="plan",
                begins=begins,
            ).to(now)
            self._refuse(due & ~drivable(now, fresh), JUMPS)
            astray = due & strays(now, fresh[:, 0])
            self._refuse(astray & reverses(now, fresh), BACKWARDS)
            self._refuse(astray, STRAYS)
            fresh = torch.cat([world.states[:, :1], fresh], 1)
            self._plan = torch.where(due[:, None, None], fresh, self._plan)
            self._planned_at = torch.where(due, world.step, self._planned_at)
        ahead = (world.step - self._planned_at)[:, None] + torch.arange(
            1 + PLAN_STEPS, device=world.step.device
        )
        return self._plan.gather(
            1, ahead.clamp(max=PLAN_STEPS)[..., None].expand(-1, -1, 4)
        )

    def _ask(self, method: str, world: World, *given: Tensor) -> Any:
        return ask(self.ego, method, world, *given, scene=self._shown)

    def _refuse(self, wrong: Tensor, why: str) -> None:
        """Raises Undrivable for rows wrong [B] bool of an ego from outside the package."""
        if from_outside(self.ego) and bool(wrong.any()):
            raise Undrivable(why, dict.fromkeys(wrong.nonzero()[:, 0].tolist(), why))


class EgoPolicy(EgoPlanner):
    """An Ego as a TorchRL policy: writes its plan and the "action" [B, 2], within the
    action's bounds."""

    in_keys = ["observation", "timestep", "agents"]
    out_keys = ["action", ("ego", "plan")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        world = World.of(tensordict, self.scene)
        with answering(world):
            plan = self.plan(world)
            answer = self._ask("act", world, tensordict["observation"], plan)
            begins = bool((world.step == 0).all())
            action = checked(
                answer, (len(plan), 2), ego=self.ego, method="act", begins=begins
            )
            wild = (action.abs() > LARGEST).any(1)
            self._refuse(wild & reverses(world.states[:, 0], plan[:, 1:]), BACKWARDS)
            self._refuse(wild, WILD)
        tensordict["action"] = action.clamp(self.bounds.low, self.bounds.high)
        tensordict["ego", "plan"] = plan[:, 1:]
        return tensordict
