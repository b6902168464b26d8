"""The gate: the interval decides, its status and files say so, and the number of
further rollouts suffices."""

import json
import math
import xml.etree.ElementTree as ET

import pytest
from scipy.stats import binom, norm

from e2rl.commands.gate import main
from e2rl.metrics.errored import errored_row
from e2rl.metrics.statistics import LEAST, exact_interval
from e2rl.report.gate import growth
from e2rl.search.tries import TRIES_FILE
from tests.evaluation.constructed_runs import row_of, run_of


def gate(capsys, run, rules, *options):
    """Status and what is said; rules: one or several."""
    rules = [rules] if isinstance(rules, str) else rules
    with pytest.raises(SystemExit) as end:
        main([str(item) for item in (run, *rules, *options)])
    said = capsys.readouterr()
    return end.value.code, said.out + said.err


def run_with(folder, places, hits, **settings):
    """A run of one rollout at each place, `hits` of them contacts, and a nominal one
    without."""
    rows = [row_of(k, hit=k < hits, progress=30.0 + k % 7) for k in range(places)]
    return run_of(
        folder,
        rows + [row_of(k, method="nominal", eta=0.0) for k in range(places)],
        settings=settings,
    )


@pytest.mark.parametrize(("limit", "places"), [(0.05, 20), (0.1, 12), (0.01, 30)])
def test_without_an_event_the_number_is_that_of_the_binomial(limit, places):
    """(1 - limit)^m = 0.025."""
    high = exact_interval(0.0, places)[1]
    needed = places * growth((0.0, 0.0, high), limit, places=places, fraction=True)
    assert needed == pytest.approx(math.log(0.025) / math.log(1 - limit), rel=1e-6)
    assert (
        binom.pmf(0, math.ceil(needed), limit)
        <= 0.025
        < binom.pmf(0, math.floor(needed), limit)
    )


@pytest.mark.parametrize(("value", "limit"), [(0.2, 0.21), (0.2, 0.19), (0.5, 0.51)])
def test_of_many_places_the_number_is_that_of_the_normal_law(value, limit):
    """m = z^2 p (1 - p) / (limit - p)^2."""
    ends = exact_interval(value, 100)
    needed = 100 * growth((value, *ends), limit, places=100, fraction=True)
    assert needed == pytest.approx(
        norm.ppf(0.975) ** 2 * value * (1 - value) / (limit - value) ** 2, rel=0.05
    )
    assert exact_interval(value, needed)[value < limit] == pytest.approx(
        limit, abs=1e-6
    )


def test_intervals_of_means_shrink_with_the_root():
    half = 4.0
    gap = 1.0
    assert growth(
        (30.0, 30 - half, 30 + half), 30 - gap, places=50, fraction=False
    ) == pytest.approx((half / gap) ** 2)
    assert growth((30.0, 26.0, 34.0), 30.0, places=50, fraction=False) is None
    assert growth((0.2, 0.1, 0.3), 0.2 + 1e-12, places=50, fraction=True) is None
    assert growth((0.1, math.nan, math.nan), 0.2, places=4, fraction=True) == LEAST / 4


def test_the_rollouts_that_it_asks_for_decide(tmp_path, capsys):
    run = run_with(tmp_path / "few", 30, hits=0)
    file = tmp_path / "gate.json"
    status, said = gate(capsys, run, "preventable<=0.05", "--json", file)
    (result,) = json.loads(file.read_text())
    assert status == 3
    assert (
        f"not enough rollouts: about {result['more']} more, at further places; "
        "preventable<=0.05: found 0.0" in said
    )
    enough = run_with(tmp_path / "enough", 30 + result["more"], hits=0)
    assert gate(capsys, enough, "preventable<=0.05")[0] == 0
    assert (
        gate(
            capsys,
            run_with(tmp_path / "short", 29 + result["more"], hits=0),
            "preventable<=0.05",
        )[0]
        == 3
    )


@pytest.mark.parametrize(
    ("rules", "status"),
    [
        (["preventable<=0.6"], 0),
        (["preventable<=0.2"], 1),
        (["preventable<=0.45"], 3),
        (["contacts>=0.2"], 0),
        (["contacts>=0.6"], 1),
        (["nominal:contacts<=0.2", "e2@2:progress>=20"], 0),
        (["preventable<=0.45", "contacts<=0.6"], 3),
        (["preventable<=0.45", "contacts<=0.2"], 1),
        (["progress<=20"], 1),
        (["preventable<=0.4"], 3),
    ],
)
def test_the_interval_decides_and_a_failure_outweighs_doubt(
    tmp_path, capsys, rules, status
):
    """40 of 100 places: the interval is about 0.31 to 0.50."""
    result, said = gate(capsys, run_with(tmp_path, 100, hits=40), rules)
    assert result == status
    assert len(said.splitlines()) == len(rules)
    assert all(rule in said for rule in rules)


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        (["preventable<0.05"], "no rule"),
        (["crashes<=0.05"], "rates: contacts, counted"),
        (["idm:contacts<=0.05"], "of which traffic in"),
        (["contacts<=+0.02"], "with --against RUN"),
        (["contacts<=0.05", "--ego", "b"], "has the egos a"),
    ],
)
def test_bad_rules_have_the_status_of_bad_input(tmp_path, capsys, rules, said):
    status, text = gate(capsys, run_with(tmp_path, 12, hits=1), rules)
    assert status == 2
    assert said in text
    assert len(text.splitlines()) == 1


def test_an_attack_must_be_named_where_there_are_several(tmp_path, capsys):
    run = run_of(
        tmp_path, [row_of(k, eta=eta) for k in range(40) for eta in (1.0, 2.0)]
    )
    status, said = gate(capsys, run, "contacts<=0.2")
    assert status == 2
    assert "e2@1:contacts, e2@2:contacts" in said
    assert gate(capsys, run, "e2@1:contacts<=0.2")[0] == 0


def test_changes_are_measured_against_a_former_run(tmp_path, capsys):
    before = run_with(tmp_path / "before", 200, hits=60)
    after = run_with(tmp_path / "after", 200, hits=20)
    assert gate(capsys, after, "contacts<=+0.02", "--against", before)[0] == 0
    assert gate(capsys, after, "contacts<=-0.1", "--against", before)[0] == 0
    assert gate(capsys, before, "contacts<=+0.02", "--against", after)[0] == 1
    assert gate(capsys, after, "contacts<=-0.2", "--against", before)[0] == 3
    assert (
        "no rule is on a change"
        in gate(capsys, after, "contacts<=0.2", "--against", before)[1]
    )
    other = run_with(tmp_path / "other", 200, hits=20, seeds=[7])
    status, said = gate(capsys, other, "contacts<=+0.02", "--against", before)
    assert status == 2
    assert "which has other seeds" in said


@pytest.mark.parametrize(
    ("rule", "status"),
    [
        ("counted<=+0.05", 0),
        ("preventable<=+0.05", 0),
        ("contacts>=-0.05", 0),
        ("contacts<=+0.04", 3),
        ("contacts<=+0", 3),
        ("contacts<=-0.05", 1),
        ("progress>=-0.5", 0),
        ("progress>=+0", 0),
        ("progress>=+0.5", 1),
    ],
)
def test_a_planner_that_has_not_changed_is_within_what_its_places_exclude(
    tmp_path, capsys, rule, status
):
    """No place of 80 differs: at most 4.5% do."""
    run = run_with(tmp_path, 80, hits=24)
    result, said = gate(capsys, run, rule, "--against", run)
    assert result == status
    assert ("[-4.5, +4.5] points" in said) == ("progress" not in rule)


@pytest.mark.parametrize(
    ("places", "limit", "more"), [(40, 0.05, 32), (40, -0.05, 32), (80, 0.04, 11)]
)
def test_the_number_for_an_unchanged_planner_is_that_without_an_event(
    places, limit, more
):
    """ln 0.025 / ln 0.95 = 72, and 90.4 for 4%."""
    bound = exact_interval(0.0, places)[1]
    assert (
        math.ceil(
            places
            * (growth((0.0, -bound, bound), limit, places=places, fraction=False) - 1)
        )
        == more
    )


def test_the_same_progress_everywhere_is_decided(tmp_path, capsys):
    run = run_of(tmp_path, [row_of(k, progress=96.0) for k in range(40)])
    assert gate(capsys, run, "progress>=50")[0] == 0
    assert gate(capsys, run, "progress>=97")[0] == 1


def test_a_rate_that_few_places_know_has_no_interval_and_says_why(tmp_path, capsys):
    run = run_of(
        tmp_path,
        [row_of(k, progress=30.0 + k if k < 5 else math.nan) for k in range(40)],
    )
    status, said = gate(capsys, run, "progress>=50")
    assert status == 3
    assert "fewer than 10 places know it, there is no interval" in said


SCHEMA = {  # of JUnit: element: (attributes it must have, attributes it may have, children)
    "testsuites": ((), (), {"testsuite"}),
    "testsuite": (
        ("name", "tests", "failures", "errors"),
        ("skipped", "time"),
        {"testcase"},
    ),
    "testcase": (
        ("classname", "name"),
        ("time",),
        {"failure", "error", "skipped", "system-out"},
    ),
    "failure": (("message",), ("type",), set()),
    "error": (("message",), ("type",), set()),
    "system-out": ((), (), set()),
}


def check(node):
    must, may, children = SCHEMA[node.tag]
    assert set(must) <= set(node.attrib) <= {*must, *may}
    assert {child.tag for child in node} <= children
    for child in node:
        check(child)


def test_the_files_for_continuous_integration_hold_what_was_decided(tmp_path, capsys):
    rules = ["preventable<=0.6", "preventable<=0.2", "preventable<=0.45"]
    files = [tmp_path / "out" / "gate.xml", tmp_path / "out" / "gate.json"]
    run = run_with(tmp_path / "run", 100, hits=40)
    gate(capsys, run, rules, "--junit", files[0], "--json", files[1])
    root = ET.fromstring(files[0].read_text())
    check(root)
    (suite,) = root
    assert [suite.get(name) for name in ("tests", "failures", "errors")] == [
        "3",
        "1",
        "1",
    ]
    assert [[child.tag for child in case][0] for case in suite] == [
        "system-out",
        "failure",
        "error",
    ]
    results = json.loads(files[1].read_text())
    assert [item["outcome"] for item in results] == [
        "passed",
        "failed",
        "not enough rollouts",
    ]
    assert (
        [case.get("name") for case in suite]
        == rules
        == [item["rule"] for item in results]
    )
    assert all(
        item["value"] == 0.4 and item["low"] < 0.4 < item["high"] for item in results
    )


def errored(scene, raised_by="ego", **values):
    """A row of a rollout that errored."""
    entry = row_of(scene) | {
        "reason": "raised RuntimeError",
        "detail": f"no\nway {scene}",
        "raised_by": raised_by,
    }
    return errored_row(entry) | values


@pytest.mark.parametrize(
    ("rule", "status"),
    [
        ("contacts<=0.3", 1),
        ("counted<=0.3", 1),
        ("preventable<=0.3", 1),
        ("clean<=0.3", 1),
        ("progress>=25", 1),
    ],
)
def test_a_planner_that_raises_fails_whatever_is_gated(tmp_path, capsys, rule, status):
    """40 of 80 rollouts: without the planner's errors none fails and each drives 30 m
    or more."""
    driven = [row_of(k, progress=30.0 + k % 7) for k in range(40)]
    assert gate(capsys, run_of(tmp_path / "driven", driven), rule)[0] == 0
    run = run_of(tmp_path / "raised", driven + [errored(40 + k) for k in range(40)])
    outcome, said = gate(
        capsys,
        run,
        rule,
        "--json",
        tmp_path / "gate.json",
        "--junit",
        tmp_path / "gate.xml",
    )
    assert outcome == status
    assert "in 40 of them the planner raised" in said
    texts = (
        said,
        (tmp_path / "gate.json").read_text(),
        (tmp_path / "gate.xml").read_text(),
    )
    for text in texts:
        assert all(
            f"scene_{k}" in text and f"RuntimeError: no way {k}" in text
            for k in range(40, 80)
        )
    (result,) = json.loads(texts[1])
    assert result["n"] == 80
    assert len(result["errored"]) == result["headline"]["raised"] == 40


@pytest.mark.parametrize(
    ("rule", "crashed", "status"),
    [
        ("contacts<=0.05", 3, 1),
        ("preventable<=0.6", 3, 1),
        ("progress>=5", 3, 1),
        ("contacts<=0.05", 2, 3),  # not in every scene
        ("contacts<=0.7", 2, 3),
        ("progress>=5", 2, 3),
        ("contacts<=1", 3, 3),
        ("contacts>=0.5", 3, 3),
    ],
)
def test_at_few_places_a_planner_that_raises_in_every_scene_fails(
    tmp_path, capsys, rule, crashed, status
):
    """3 scenes give no interval; those in which it raised break a limit below their
    fraction, whatever else happens."""
    rows = [
        errored(k, seed=seed) if k < crashed else row_of(k, seed)
        for k in range(3)
        for seed in (0, 1)
    ]
    result, said = gate(capsys, run_of(tmp_path, rows), rule)
    alone = f"in {2 * crashed} of them the planner raised: these alone break the "
    alone += f"limit, in {crashed} of 3 scenes"
    assert result == status
    assert (alone in said) == (status == 1 or rule == "contacts<=0.05")
    assert said.startswith("failed" if status == 1 else "not enough rollouts")


@pytest.mark.parametrize(("limit", "status"), [(0.3, 1), (0.4, 3), (0.6, 3), (0.7, 0)])
def test_where_all_places_are_alike_the_exact_interval_decides(
    tmp_path, capsys, limit, status
):
    """One of two rollouts at each of 12 places: of 12, none, so at most 26%, is
    otherwise, and then 0 or 1."""
    rows = [errored(k) if seed else row_of(k) for k in range(12) for seed in (0, 1)]
    result, said = gate(capsys, run_of(tmp_path, rows), f"contacts<={limit}")
    assert result == status
    assert "found 50.0 [36.8, 63.2] %" in said


def test_people_and_objects_have_rates_of_their_own(tmp_path, capsys):
    """No vehicle is hit; of 40 places a pedestrian is at 20, a cone at 1."""
    rows = [
        row_of(k, cfr_vru=float(k % 2), cfr_object=float(k == 0)) for k in range(40)
    ]
    run = run_of(tmp_path / "run", rows)
    assert gate(capsys, run, "contacts<=0.1")[0] == 0
    status, said = gate(capsys, run, "contacts_vru<=0.1")
    assert status == 1
    assert "found 50.0" in said
    assert "a touched a pedestrian or cyclist in 20 of 40 rollouts" in said
    assert gate(capsys, run, "contacts_object<=0.2")[0] == 0
    assert gate(capsys, run, "contacts_object<=0.01")[0] == 3
    crashed = run_of(tmp_path / "raised", rows[:1] + [errored(k) for k in range(1, 40)])
    assert gate(capsys, crashed, "contacts_vru<=0.1")[0] == 1, (
        "to raise is to fail, here too"
    )


def test_what_the_traffic_raised_is_named_and_counts_neither_way(tmp_path, capsys):
    driven = [row_of(k, hit=k < 8) for k in range(80)]
    run = run_of(tmp_path, driven + [errored(80 + k, "traffic") for k in range(40)])
    _, said = gate(capsys, run, "contacts<=0.3", "--json", tmp_path / "gate.json")
    (result,) = json.loads((tmp_path / "gate.json").read_text())
    assert (result["n"], result["value"]) == (80, 0.1)
    assert len(result["errored"]) == 40
    assert "The traffic raised in 40 of 120 rollouts, left out" in said
    assert "scene_119" in said


@pytest.mark.parametrize("limit", ["5", "1.01", "41.7", "100", "00002"])
@pytest.mark.parametrize("rate", ["contacts", "preventable", "counted", "clean"])
def test_a_limit_that_no_fraction_reaches_is_refused(tmp_path, capsys, rate, limit):
    status, said = gate(capsys, run_with(tmp_path, 100, hits=40), f"{rate}<={limit}")
    assert status == 2
    assert "write a number from 0 to 1, such as 0.05 for 5%" in said


@pytest.mark.parametrize(
    "rule",
    [
        "contacts<=+1.5",
        "contacts>=-2",
        "contacts<=nan",
        "contacts<=inf",
        "contacts<=1e-2",
    ],
)
def test_what_is_no_limit_is_refused(tmp_path, capsys, rule):
    before = run_with(tmp_path / "before", 40, hits=4)
    assert (
        gate(
            capsys, run_with(tmp_path / "after", 40, hits=4), rule, "--against", before
        )[0]
        == 2
    )


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"cfr": -1.0}, "cfr of scene_3, seed 0 is -1"),
        ({"cfr_preventable": math.inf}, "cfr_preventable of scene_3, seed 0 is inf"),
        ({"cfr_clean": 7.0}, "cfr_clean of scene_3, seed 0 is 7"),
        ({"progress": math.inf}, "progress of scene_3, seed 0 is inf"),
        ({"progress": -math.inf}, "progress of scene_3, seed 0 is -inf"),
        (
            {"cfr": 1.0, "cfr_counted": math.nan},
            "cfr_counted of scene_3, seed 0 is empty",
        ),
    ],
)
def test_values_that_no_rollout_has_are_errors(tmp_path, capsys, values, said):
    run = run_of(tmp_path, [row_of(k, **(values if k == 3 else {})) for k in range(20)])
    status, text = gate(capsys, run, "preventable<=0.5")
    assert status == 2
    assert said in text


@pytest.mark.parametrize("searched", [False, True])
@pytest.mark.parametrize(
    "column", ["cfr", "cfr_counted", "cfr_preventable", "cfr_clean", "progress"]
)
def test_an_empty_column_is_an_error_and_no_zero(tmp_path, capsys, column, searched):
    run = run_of(tmp_path, [row_of(k, **{column: math.nan}) for k in range(20)])
    if searched:
        (run / TRIES_FILE).write_text("")
    status, text = gate(capsys, run, "preventable<=0.5")
    assert status == 2
    assert f"the column {column} is empty" in text


def test_a_run_without_all_of_its_rollouts_is_refused(tmp_path, capsys):
    rows = [row_of(k, seed) for k in range(12) for seed in (0, 1)]
    (tmp_path / "scenes.csv").write_text(
        "scene_id\n" + "\n".join(f"scene_{k}" for k in range(12))
    )
    assert gate(capsys, run_of(tmp_path, rows), "preventable<=0.9")[0] in (0, 3)
    status, said = gate(capsys, run_of(tmp_path, rows[:-3]), "preventable<=0.9")
    assert status == 2
    assert (
        "lacks 3 of 24 rollouts of e2 η=2 (scene_10 seed 1, scene_11 seed 0, scene_11 seed 1)"
        in said
    )
    (tmp_path / "rollouts.csv").unlink()
    (tmp_path / "parts").mkdir()
    status, said = gate(capsys, tmp_path, "preventable<=0.9")
    assert status == 2
    assert f"go on with its command by resume={tmp_path}" in said


@pytest.mark.parametrize(
    "rule",
    [
        "no anchoring:contacts<=0.2",
        " no anchoring : contacts <= 0.2 ",
        "no anchoring@2:contacts<=.2",
    ],
)
def test_a_method_s_name_may_hold_spaces(tmp_path, capsys, rule):
    run = run_of(
        tmp_path,
        [
            row_of(k, method=method)
            for k in range(40)
            for method in ("e2", "no anchoring")
        ],
    )
    assert gate(capsys, run, rule)[0] == 0


def test_where_the_traffic_lost_every_rollout_nothing_passes(tmp_path, capsys):
    run = run_of(
        tmp_path,
        [errored(k, "traffic") for k in range(40)]
        + [row_of(k, method="b") for k in range(40)],
    )
    status, said = gate(capsys, run, "e2:contacts<=0.9")
    assert status == 2
    assert "the traffic raised in all of its rollouts" in said
