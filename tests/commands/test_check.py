"""`e2rl check` names the mistake of each wrong planner in one line, finds none in sound
ones, and says all that is wrong with a configuration at once."""

import sys

import pytest
import torch

from e2rl import save_policy
from e2rl.evaluation import planner_check
from e2rl.evaluation.planner_check import PlannerCheck, telling_scenes
from e2rl.run.config import load_config
from e2rl.scenes.source import load_scenes
from e2rl.sim.env import SimSettings
from tests.planners import wrong_planners
from tests.planners.planners import command_of
from tests.scripts import SHORT, arguments, call

SCENES = ["num_scenes=4", "data.build.steps=30"]


@pytest.fixture(scope="module")
def scenes():
    config = load_config("evaluate", [*SHORT, *SCENES])
    return telling_scenes(load_scenes(config.data, 6))


@pytest.fixture
def wrong(scenes, monkeypatch):
    """Returns the findings that are wrong with a planner, by what they are about."""
    monkeypatch.setattr(planner_check, "LONGEST", 0.8)

    def findings(kind):
        check = PlannerCheck(kind, scenes, sim=SimSettings())
        return {
            finding.about: f"{finding.text}; {finding.mend}"
            for finding in check.findings()
            if finding.fine is False
        }

    return findings


def test_the_scenes_are_at_different_places(scenes):
    assert len(set(scenes.location[:2])) == 2


def test_nothing_is_wrong_with_a_sound_planner(wrong):
    assert wrong(wrong_planners.Steady) == {}


@pytest.mark.parametrize(
    ("kind", "about", "text"),
    [
        ("Short", "answers", "Short.plan: returns torch.float32 [3, 40, 4], expected"),
        ("NotANumber", "answers", "plan is NaN or infinite, step 5 of "),
        ("OfTheEgo", "frame", "plans are in the frame of the ego; turn and shift"),
        ("OfTheWorld", "frame", "plans are in coordinates of another origin; shift"),
        ("Degrees", "frame", "plans are of headings in degrees; give radians"),
        ("Mirrored", "frame", "plans are mirrored: y and headings"),
        ("Random", "repeats", "is random: the same moments get answers that differ"),
        ("Remembers", "repeats", "remembers what was before a reset"),
        ("Mutates", "inputs", "it changes world.scene['size'], world.states in place"),
        ("Leaks", "memory", "grows by "),
        ("Slow", "time", "slower than it drives; raise ego.replan_every"),
        ("Raises", "answers", "raises ZeroDivisionError: no lane ahead at "),
        ("Mixes", "rows", "alone differs by "),
        ("Stands", "motion", "it stands in all scenes after"),
        ("DegreesPerSecond", "bounds", "0.0 m/s^2 and 20.00 rad/s; beyond the bounds"),
    ],
)
def test_a_wrong_planner_is_named_in_one_line(wrong, kind, about, text):
    findings = wrong(getattr(wrong_planners, kind))
    assert text in findings.pop(about)
    assert not findings


def test_a_planner_that_hangs_is_given_up(wrong, monkeypatch):
    """Even if it catches all exceptions; the line is said where it waits."""
    monkeypatch.setattr(planner_check, "PATIENCE", 1.0)
    findings = wrong(wrong_planners.Hangs)
    text = findings.pop("answers")
    assert text.startswith("gives no answer within 1 s at ")
    assert "wrong_planners.py:" in text
    assert not findings


@pytest.fixture
def check(tmp_path, monkeypatch, capsys):
    """Runs the command; returns its status and what it prints."""

    def run(*options):
        printed = []
        monkeypatch.setattr("builtins.print", lambda *words, **_: printed.extend(words))
        options = [
            *SHORT,
            *SCENES,
            "processes=1",
            f"hydra.run.dir={tmp_path}",
            *options,
        ]
        status, _ = call(
            "e2rl/commands/cli.py",
            ["check", *options],
            monkeypatch=monkeypatch,
            capsys=capsys,
        )
        return status, "\n".join(printed)

    return run


def test_a_line_of_the_planners_own_file_is_named(wrong):
    assert "wrong_planners.py:" in wrong(wrong_planners.Raises)["answers"]


KINDS = [
    ["ego=class", "ego._target_=tests.planners.wrong_planners.Steady"],
    ["ego=lane_graph"],
    ["ego=external", f"ego.command='{command_of()}'"],
    ["ego=policy_file", "ego.file={policy}"],
    ["ego=actor", "ego.checkpoint=bundled"],
]


@pytest.mark.parametrize(
    "options",
    [KINDS[0], *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[1:])],
    ids=lambda options: options[0],
)
def test_each_kind_of_planner_passes(check, tmp_path_factory, options):
    policy = tmp_path_factory.mktemp("policy") / "policy.pt"
    save_policy(Straight(), policy)
    status, printed = check(*(option.format(policy=policy) for option in options))
    assert "FAIL" not in printed
    assert status == 0
    assert "about 4 in the run" in printed
    assert "nothing is wrong" in printed


class Straight(torch.nn.Module):
    def forward(self, observation):
        return 0 * observation[:, :2]


def test_all_that_is_wrong_is_said_at_once(check):
    status, printed = check(
        "eta=5",
        "prior.checkpoint=nowhere",
        "data=scenarionet",
        "data.path=/nowhere",
        "ego=class",
        "ego._target_=tests.planners.wrong_planners.Degrees",
    )
    assert status == 1
    wrong = [line.split()[1] for line in printed.splitlines() if "FAIL" in line]
    assert wrong == ["options", "data", "prior", "frame"]


def test_damaged_recordings_are_named(check, world, tmp_path):
    options = arguments(world, tmp_path, "nan", "ego=idm")
    status, printed = check(*options)
    assert status == 1
    (line,) = [line for line in printed.splitlines() if "FAIL" in line]
    assert "left out" in line
    assert "or data.skip_invalid=true leaves it out" in line


def test_a_class_is_named_as_for_try(check, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    planner = "tests.planners.wrong_planners:Mirrored"
    status, printed = check("--planner", planner)
    assert status == 1
    assert "planner Mirrored" in printed
