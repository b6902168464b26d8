"""OpenSCENARIO: scenariogeneration's parser gets back every state, and the standard's
schema holds."""

import warnings

import numpy as np
import pytest

pytest.importorskip(
    "scenariogeneration", reason="--to openscenario needs the extra openscenario"
)
from scenariogeneration import xosc  # noqa: E402

from e2rl.report.export.episode import EGO
from e2rl.scenes.recording import CYCLIST, PEDESTRIAN
from tests.report.export.small_run import (
    GAPS,
    LATE,
    TRUCK,
    exported,
    rollout_of,
    row_of,
)  # noqa: E402


def parsed(paths):
    """The scenarios in files; an invalid one raises."""
    with warnings.catch_warnings():
        warnings.simplefilter(
            "error"
        )  # ParseOpenScenario warns of what breaks the schema
        return [xosc.ParseOpenScenario(str(path)) for path in paths]


@pytest.fixture(scope="module")
def scenarios(run, tmp_path_factory):
    return parsed(
        exported(run, tmp_path_factory.mktemp("openscenario") / "out", "openscenario")
    )


def entities_of(scenario):
    """{row: entity object}"""
    named = {
        item.name: item.entityobject for item in scenario.entities.scenario_objects
    }
    return {
        0 if name == EGO else int(name.removeprefix("agent_")): result
        for name, result in named.items()
    }


def events_of(scenario):
    """(row, time of the trigger, actions) of every event"""
    (story,) = scenario.storyboard.stories
    (act,) = story.acts
    for group in act.maneuvergroup:
        name = group.actors.actors[0].entity
        row = 0 if name == EGO else int(name.removeprefix("agent_"))
        for event in group.maneuvers[0].events:
            condition = event.trigger.conditiongroups[0].conditions[0].valuecondition
            yield row, condition.value, [part.action for part in event.action]


def test_every_state_comes_back_and_no_other(run, scenarios):
    for index, scenario in enumerate(scenarios):
        rollout = rollout_of(run, index)
        boxes = entities_of(scenario)
        observed = np.zeros(rollout.valid.shape, bool)
        for row, start, actions in events_of(scenario):
            ahead = boxes[row].boundingbox.center.x
            for action in actions:
                if not isinstance(action, xosc.FollowTrajectoryAction):
                    continue
                shape = action.trajectory.shapes
                assert shape.time[0] == pytest.approx(start)
                assert action.timeref.scale == 1
                for time, place in zip(shape.time, shape.positions, strict=True):
                    step = round(time / 0.1)
                    middle = [
                        place.x + ahead * np.cos(place.h),
                        place.y + ahead * np.sin(place.h),
                    ]
                    x, y, heading, _ = rollout.states[step, row]
                    turned = (heading - place.h + np.pi) % (2 * np.pi) - np.pi
                    assert abs(step * 0.1 - time) < 1e-6
                    assert np.hypot(*(np.array(middle) - [x, y])) < 0.01
                    assert abs(turned) < 1e-3
                    observed[step, row] = True
                assert (
                    np.abs(np.diff([place.h for place in shape.positions])).max() < 0.5
                )  # headings do not jump
        observed[GAPS[2][0], LATE] = True  # a single step has no polyline
        assert (observed == rollout.valid).all()


def test_who_appears_late_is_added_then_and_deleted_when_gone(scenarios):
    result = [
        (type(a), row, start)
        for row, start, actions in events_of(scenarios[0])
        for a in actions
    ]
    for kind, steps in zip(
        (xosc.AddEntityAction, xosc.DeleteEntityAction),
        zip(*GAPS, strict=True),
        strict=True,
    ):
        assert sorted(item[1:] for item in result if item[0] == kind) == [
            (LATE, step / 10) for step in steps
        ]


def test_boxes_types_and_reference_points(run, scenarios):
    rollout = rollout_of(run, 0)
    result = entities_of(scenarios[0])
    for row, entity in result.items():
        sides = entity.boundingbox.boundingbox
        assert [sides.length, sides.width] == pytest.approx(
            rollout.size[row].tolist(), abs=1e-5
        )
    kinds = [
        result[row].vehicle_type.get_name()
        for row in (0, TRUCK, row_of(rollout, CYCLIST))
    ]
    assert kinds == ["car", "truck", "bicycle"]
    assert isinstance(result[row_of(rollout, PEDESTRIAN)], xosc.Pedestrian)
    axles = result[0].axles
    assert axles.rearaxle.xpos == 0
    assert axles.frontaxle.xpos == pytest.approx(2 * result[0].boundingbox.center.x)
