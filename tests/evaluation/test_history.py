"""Scenes over versions: which broke, were mended, come and go."""

import pytest

from e2rl.evaluation.history import (
    ALWAYS,
    FLICKERS,
    LASTS,
    MENDED,
    NEVER,
    NEW,
    change_of,
    scene_histories,
    scene_results,
    version_names,
)
from e2rl.metrics.errored import TRAFFIC
from tests.evaluation.constructed_runs import row_of

STATES = {"x": True, ".": False, "-": None}


@pytest.mark.parametrize(
    ("states", "change", "version"),
    [
        ("...x", NEW, 3),
        (".-.x", NEW, 3),
        ("..xx", LASTS, 2),
        ("xx..", MENDED, 2),
        (".xx.", MENDED, 3),
        ("xx-.", MENDED, 3),
        ("x..x", FLICKERS, 3),
        (".x.x", FLICKERS, 3),
        ("x.x.", FLICKERS, 3),
        ("xxxx", ALWAYS, -1),
        ("--xx", ALWAYS, -1),  # nothing is known of what the first ones do
        ("..-.", NEVER, -1),
    ],
)
def test_the_change_of_a_scene_is_that_of_the_versions_that_drove_it(
    states, change, version
):
    assert change_of([STATES[state] for state in states]) == (change, version)


def test_the_worst_rollout_of_a_scene_counts():
    fault = {"cfr_preventable": 0.0}
    harmless = fault | {"cfr_counted": 0.0}
    rows = [
        *(row_of(0, seed=0), row_of(0, seed=1, hit=True), row_of(0, seed=2, hit=True)),
        *(row_of(1, hit=harmless), row_of(1, seed=1, hit=fault)),
        *(row_of(2, hit=harmless), row_of(3, cfr_vru=1.0), row_of(4)),
        *(row_of(5, hit=True), row_of(5, seed=1, errored=1.0, raised_by="")),
        row_of(6, errored=1.0, raised_by=TRAFFIC),
    ]
    results = scene_results(rows)
    kinds = {scene: result.kind for scene, result in results.items()}
    assert kinds == dict(
        scene_0="P", scene_1="C", scene_2="H", scene_3="H", scene_4="·", scene_5="E"
    )
    assert (results["scene_0"].events, results["scene_0"].rollouts) == (2, 3)
    assert results["scene_0"].row["seed"] == 1


def test_the_latest_change_comes_first():
    failing = [{1, 2, 3}, {1, 3, 4}, {2, 4, 5, 1}]  # scenes by version; 0 never
    versions = [
        scene_results([row_of(scene, hit=scene in hits) for scene in range(6)])
        for hits in failing
    ]
    order = [(item.scene, item.change) for item in scene_histories(versions)]
    assert order == [
        ("scene_5", NEW),
        ("scene_3", MENDED),
        ("scene_2", FLICKERS),
        ("scene_4", LASTS),
        ("scene_1", ALWAYS),
        ("scene_0", NEVER),
    ]


def test_names_have_the_parts_that_tell_runs_apart(tmp_path):
    runs = [tmp_path / "a" / "x", tmp_path / "b" / "x"]
    assert version_names(runs) == ["a/x", "b/x"]
    assert version_names([tmp_path / "v1", tmp_path / "v2"]) == ["v1", "v2"]
