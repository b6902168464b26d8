"""A planner that raises or returns NaN loses its own rollouts, and these are counted;
all others are scored."""

import json
import re

import pytest
import torch

from e2rl.driving.setup import Method, Setup
from e2rl.evaluation.protocol import run_protocol
from e2rl.evaluation.rollout_files import (
    ERRORED_FILE,
    METRICS_FILE,
    TABLE,
    add_errored,
    read_metrics,
    read_rows,
)
from e2rl.planners.idm_planner import IDMEgo
from e2rl.report.answer import answer_lines
from e2rl.report.html import write_report
from e2rl.report.tables import metric_tables
from e2rl.run.errors import InputError
from e2rl.sim.rollout_file import ROLLOUTS
from e2rl.sim.settings import SimSettings
from e2rl.traffic.rule_based import LogReplay
from tests.traffic.e2.traffic_scenes import scenes

METHODS = [Method("replay", LogReplay())]


class Fails(IDMEgo):
    """Raises, or plans another x at the 20th step, where the ego of a scene starts at
    the given speed."""

    def __init__(self, speed: float, fault: BaseException | float) -> None:
        super().__init__()
        self.speed = speed
        self.fault = fault

    def plan(self, world):
        plan = super().plan(world)
        bad = (world.scene["start"][:, 0, 3] - self.speed).abs() < 1e-6
        if isinstance(self.fault, BaseException):
            if bad.any():
                raise self.fault
            return plan
        plan[bad, 20, 0] += self.fault
        return plan


class Short(Fails):
    """Plans too few steps from the third step on."""

    def plan(self, world):
        bad = (world.scene["start"][:, 0, 3] - self.speed).abs() < 1e-6
        plan = IDMEgo.plan(self, world)
        return plan[:, :10] if bad.any() and (world.step > 2).any() else plan


class Wild(Fails):
    """Acts NaN."""

    def act(self, world, observation, plan):
        action = super().act(world, observation, plan)
        return action.where(
            ((world.scene["start"][:, 0, 3] - self.speed).abs() > 1e-6)[:, None],
            torch.nan,
        )


class Dissolves(LogReplay):
    """Its vehicles become NaN where the ego of a scene starts at 8 m/s."""

    def replan(self, state, world, ego_plan):
        state, plan = super().replan(state, world, ego_plan)
        bad = (world.scene["start"][:, 0, 3] - 8.0).abs() < 1e-6
        plan.states[bad, 1:] = torch.nan
        return state, plan


class Refuses(LogReplay):
    """Raises where the ego of a scene starts at 8 m/s."""

    def replan(self, state, world, ego_plan):
        if bool(((world.scene["start"][:, 0, 3] - 8.0).abs() < 1e-6).any()):
            raise KeyError("route")
        return super().replan(state, world, ego_plan)


NO_WAY = ZeroDivisionError("no way out")
FAULTS = {
    "ZeroDivisionError": (NO_WAY, "no way out"),
    "NotFinite": (torch.nan, "the ego's plan is NaN"),
    "Undrivable": (500.0, "jumps"),
    "PlannerExited": (SystemExit(0), "sys.exit.0."),
}


def scene_set(count: int = 4, steps: int = 10):
    result = scenes(count, steps=steps)
    result.scenes["start"][:, 0, 3] = 6.0 + torch.arange(count)
    return result


def run(ego, folder=None, batch=64, processes=1, count=4, steps=10):
    setup = Setup(
        scene_set(count, steps), ego, ego_name="fails", sim=SimSettings(), batch=batch
    )
    return run_protocol(
        setup, METHODS, seeds=[0, 1], folder=folder, processes=processes
    )


@pytest.mark.parametrize(
    ("name", "processes"),
    [*((name, 1) for name in FAULTS), ("PlannerExited", 2)],
)
def test_the_others_are_scored_and_the_count_stands_everywhere(
    tmp_path, name, processes
):
    (fault, detail), reason = FAULTS[name], f"raised {name}"
    ego = Fails(8.0, fault)
    (row,) = run(ego, tmp_path, batch=4, processes=processes, steps=20)
    assert row["n_rollouts"] == 8
    assert row["errored"] == {reason: 2}
    assert row["n_scenes"] == 4
    assert row["metrics"]["errored"]["mean"] == 0.25
    assert row["metrics"]["real"]["n"] == 6
    assert row["metrics"]["cfr_preventable"]["mean"] >= 0.25, "to raise is to fail"
    assert read_metrics(tmp_path / METRICS_FILE)[0]["errored"] == {reason: 2}
    assert f"2 rollouts without a score ({reason})" in metric_tables([row])[0].caption
    entries = json.loads((tmp_path / ERRORED_FILE).read_text())
    assert {(entry["scene_id"], entry["seed"]) for entry in entries} == {
        (scene_set().scene_id[2], k) for k in (0, 1)
    }
    assert all(re.search(detail, entry["traceback"]) for entry in entries)
    rows = read_rows(tmp_path / TABLE)
    assert len(rows) == 8
    assert len(list((tmp_path / ROLLOUTS).glob("*.npz"))) == 6
    ends = {
        (row["scene_id"], row["seed"], row["raised_by"])
        for row in rows
        if row["errored"] == 1
    }
    assert ends == {(scene_set().scene_id[2], seed, "ego") for seed in (0, 1)}
    assert all(re.search(detail, row["error"]) for row in rows if row["errored"] == 1)


def test_a_run_in_which_nobody_raises_leaves_no_list_of_an_earlier_run(tmp_path):
    (tmp_path / ERRORED_FILE).write_text("[]")
    (row,) = run(IDMEgo(), tmp_path, count=1)
    assert row["errored"] == {}
    assert row["n_rollouts"] == 2
    assert not (tmp_path / ERRORED_FILE).exists()


def test_where_the_traffic_loses_all_the_message_says_why(tmp_path):
    setup = Setup(scene_set(3), IDMEgo(), ego_name="idm", sim=SimSettings(), batch=4)
    setup.scenes.scenes["start"][:, 0, 3] = 8.0
    with pytest.raises(
        InputError,
        match="no rollout could be scored: 3 raised KeyError .'route'.*traceb",
    ):
        run_protocol(setup, [Method("refuses", Refuses())], seeds=[0], folder=tmp_path)
    with pytest.raises(
        InputError,
        match="no metrics.json: .*errored.json says then; `e2rl gate` and `e2rl compare`",
    ):
        write_report(tmp_path)


def test_a_planner_that_always_raises_is_rated_as_any_other(tmp_path):
    (row,) = run(Fails(6.0, NO_WAY), tmp_path, count=1)
    assert row["n_rollouts"] == 2
    assert row["errored"] == {"raised ZeroDivisionError": 2}
    assert (
        row["headline"] | {"scenes": 1, "raised": 1, "failed": 1, "preventable": 0}
        == row["headline"]
    )
    result = {
        name: row["metrics"][name]["mean"]
        for name in ("cfr", "cfr_preventable", "errored", "progress")
    }
    assert result == {
        "cfr": 1.0,
        "cfr_preventable": 1.0,
        "errored": 1.0,
        "progress": 0.0,
    }
    assert row["metrics"]["real"]["n"] == row["metrics"]["counted_per_km"]["n"] == 0
    assert read_metrics(tmp_path / METRICS_FILE)[0]["headline"] == row["headline"]
    text = " ".join(
        " ".join(answer_lines([row], rollouts=read_rows(tmp_path / TABLE))).split()
    )
    assert (
        "preventable failures, or it raised, in 1 of 1 scene; preventable failures in "
        "0 of 1; it raised in 1" in text
    )
    assert "ZeroDivisionError: no way out (2 under replay)" in text
    assert "per 1,000 km" not in text
    page = write_report(tmp_path).read_text()
    assert "ZeroDivisionError: no way out" in page
    assert "it raised in 1 of 1." in page


def test_a_method_of_which_all_rollouts_end_stays_in_the_table(tmp_path):
    class Lost(LogReplay):
        def replan(self, *rest):
            raise ZeroDivisionError("no way out")

    setup = Setup(scene_set(2), IDMEgo(), ego_name="idm", sim=SimSettings(), batch=4)
    rows = run_protocol(
        setup,
        [*METHODS, Method("lost", Lost(), eta=0.0)],
        seeds=[0],
        folder=tmp_path,
        stage="before",
    )
    assert [(row["method"], row["n_rollouts"]) for row in rows] == [
        ("replay", 2),
        ("lost", 0),
    ]
    assert rows[1]["errored"] == {"raised ZeroDivisionError": 2}
    assert rows[1]["metrics"]["cfr"]["n"] == 0
    assert (
        "lost: 0 scenes, 0 seeds, 0 rollouts, 2 rollouts without a score"
        in metric_tables(rows)[0].caption
    )
    assert read_metrics(tmp_path / METRICS_FILE)[1]["method"] == "lost"


def test_what_ended_in_a_training_is_kept_by_round_and_not_doubled_by_a_resumed_one(
    tmp_path,
):
    path = tmp_path / ERRORED_FILE
    for number, reasons in ((0, "ab"), (1, ""), (2, "c"), (1, "d")):
        add_errored(
            path,
            number,
            errored=[{"round": number, "reason": reason} for reason in reasons],
        )
    assert [entry["reason"] for entry in json.loads(path.read_text())] == [
        "a",
        "b",
        "d",
    ]


@pytest.mark.parametrize(
    ("ego", "traffic", "blamed"),
    [
        (Short(8.0, 0.0), LogReplay(), "ego"),
        (Wild(8.0, 0.0), LogReplay(), "ego"),
        (Fails(8.0, NO_WAY), LogReplay(), "ego"),
        (IDMEgo(), Dissolves(), "traffic"),
        (Fails(8.0, NO_WAY), Refuses(), "ego"),
        (IDMEgo(), Refuses(), "traffic"),
    ],
)
def test_whose_error_it_is(tmp_path, ego, traffic, blamed):
    """An ego that cannot answer about vehicles that are NaN is not to blame; it is
    asked before the traffic."""
    setup = Setup(scene_set(), ego, ego_name="e", sim=SimSettings(), batch=4)
    (row,) = run_protocol(setup, [Method("m", traffic)], seeds=[0], folder=tmp_path)
    (errored,) = [row for row in read_rows(tmp_path / TABLE) if row["errored"] == 1]
    assert (errored["scene_id"], errored["raised_by"]) == (
        scene_set().scene_id[2],
        blamed,
    )
    assert row["n_rollouts"] == (4 if blamed == "ego" else 3)
    assert row["metrics"]["errored"]["mean"] == (0.25 if blamed == "ego" else 0.0)


class From(IDMEgo):
    """Plans too few steps from its n-th call on."""

    def __init__(self, call):
        super().__init__()
        self.call = call
        self.calls = 0

    def plan(self, world):
        self.calls += 1
        return super().plan(world)[:, : 10 if self.calls >= self.call else None]


@pytest.mark.parametrize("processes", [1, 2])
@pytest.mark.parametrize("batch", [2, 64])
def test_a_wrong_shape_of_the_very_first_plan_is_a_mistake_of_the_code(
    tmp_path, batch, processes
):
    said = rf"From.plan: returns torch.float32 \[{min(batch, 8)}, 10, 4\], expected a tensor of floats"
    with pytest.raises(InputError, match=said):
        run(From(1), tmp_path, batch=batch, processes=processes)


@pytest.mark.parametrize(("call", "batch", "raise_in"), [(2, 64, 8), (11, 2, 6)])
def test_a_wrong_shape_later_on_ends_rollouts_and_not_the_run(
    tmp_path, call, batch, raise_in
):
    """A rollout has 10 plans: of batches of two, those after the first raise from their
    start on."""
    (row,) = run(From(call), tmp_path, batch=batch)
    assert row["n_rollouts"] == 8
    assert sum(row["errored"].values()) == raise_in
    rows = [row for row in read_rows(tmp_path / TABLE) if row["errored"] == 1]
    assert {row["raised_by"] for row in rows} == {"ego"}
    assert all(
        "From.plan: returns torch.float32 [1, 10, 4], expected a tensor of floats [1, 50,"
        in row["error"]
        for row in rows
    )
