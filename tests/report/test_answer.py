"""The answer on the terminal: what it says of known rows, and that it fits 80 columns
and 25 lines."""

import math
from pathlib import Path

import pytest

from e2rl.metrics.atlas import CELL
from e2rl.report.answer import LINES, answer_lines
from e2rl.report.before_after import compared_answer
from tests.report.known_rates import ego_rates

NAN = math.nan


def value(mean, n=12, low=NAN, high=NAN):
    return {"mean": mean, "low": low, "high": high, "n": n}


def row(method="nominal", eta=0.0, ego="lane_graph", cfr=0.0, n=12):
    """A row of metrics.json in which every collision counts and is the ego's fault."""
    hits = round(cfr * n)
    metrics = {
        "cfr": value(cfr, n),
        "cfr_counted": value(cfr, n),
        "counted_per_km": value(cfr / 0.05, n),
    }
    metrics |= {"cfr_preventable": value(cfr / 3, n), "cfr_clean": value(cfr / 3, n)}
    metrics |= {
        "counted": value(1.0 if hits else NAN, hits),
        "at_fault": value(1.0 if hits else NAN, hits),
    }
    metrics |= {
        "preventable": value(1 / 3 if hits else NAN, hits),
        "real": value(0.9),
        "real_adv": value(NAN, 0),
    }
    metrics |= {"aor_step": value(0.01), "cfr_bg": value(0.0), "progress": value(50.0)}
    about = {
        "dataset": "bundled",
        "split": "test",
        "n_scenes": n,
        "n_seeds": 1,
        "n_rollouts": n,
        "paired": {},
    }
    return about | {
        "method": method,
        "ego": ego,
        "eta": eta,
        "errored": {"lost": 2},
        "metrics": metrics,
    }


def mode(number, name, count, counted, nominal=0):
    """A mode of failures under an attack, of which `counted` count, and of `nominal`
    ones in nominal traffic, all of which do."""
    groups = [
        {"count": nominal, "counted": nominal},
        {"count": count, "counted": counted},
    ]
    return {"mode": number, "name": name, "groups": groups}


def modes_of(*modes):
    failures = [
        sum(mode["groups"][place]["count"] for mode in modes) for place in (0, 1)
    ]
    groups = [
        {"eta": eta, "failures": count}
        for eta, count in zip((0.0, 2.0), failures, strict=True)
    ]
    return {"failures": sum(failures), "groups": groups, "modes": list(modes)}


MODES = modes_of(
    mode(1, "rear", count=4, counted=0),
    mode(2, "oncoming", count=2, counted=2),
    mode(0, "other", count=2, counted=2),
)


def test_an_attack_is_told_with_its_numbers_and_the_weaknesses_that_count():
    attack = row("e2", 2.0, cfr=0.25)
    text = " ".join(" ".join(answer_lines([row(cfr=1 / 12), attack], MODES)).split())
    assert "hit in 3 of 12 rollouts, of them 1 preventable, 1 clean; 3 count." in text
    assert "nominal 8.3% (1 of 12)" in text
    assert "1. oncoming (2 of 8 failures, 2 count)" in text
    assert "rear (" not in text
    assert "other (" not in text
    assert "4 rollouts without a score" in text


def test_methods_stand_by_what_they_find_and_egos_by_how_little():
    lines = answer_lines([row(), row("a", 1.0, cfr=1 / 4), row("b", 1.0, cfr=1 / 2)])
    assert [line.split()[0] for line in lines if " of 12)" in line] == [
        "b",
        "a",
        "nominal",
    ]
    assert lines[0].startswith(
        "lane_graph fails most in the traffic of b η=1: hit in 6 of 12 rollouts"
    )
    lines = answer_lines(
        [
            row("e2", 2.0, ego=ego, cfr=cfr)
            for ego, cfr in (("idm", 0.5), ("actor", 0.25))
        ]
    )
    assert [line.split()[0] for line in lines if " of 12)" in line] == ["actor", "idm"]
    lines = answer_lines([row(), row("a", 1.0), row("b", 1.0)])
    assert lines[0].startswith(
        "lane_graph does not fail, not even in the traffic of a η=1: hit in 0 of 12"
    )
    contacts = row("b", 2.0, cfr=0.5)
    contacts["metrics"] |= dict.fromkeys(
        ("cfr_preventable", "cfr_clean", "cfr_counted"), value(0.0)
    )
    lines = answer_lines([row(), row("a", 1.0), contacts])
    assert lines[0].startswith("lane_graph fails most in the traffic of b")


def test_before_and_after_stand_side_by_side():
    old = row("e2", 2.0, cfr=0.5)
    new = row("e2", 2.0, cfr=0.25)
    new["paired"] = {
        "before": {"cfr": {"difference": -0.25, "low": -0.4, "high": -0.1, "n": 12}}
    }
    (line,) = [
        line for line in compared_answer([old], [new]) if line.startswith("hit, ")
    ]
    assert line.split("  ")[-1].strip() == "-25 [-40, -10]"
    assert "50% (6 of 12)" in line
    assert "25% (3 of 12)" in line


def atlas(failed, **scenes):
    """An atlas of ways to fail, each with its number of scenes."""
    cells = [
        dict.fromkeys(CELL, "") | {"approach": name, "scenes": count}
        for name, count in scenes.items()
    ]
    return {"scenes": 12, "failed_scenes": failed, "cells": len(cells), "atlas": cells}


def test_the_ways_before_and_after_training_stand_side_by_side(tmp_path):
    old = row("e2", 2.0, cfr=0.5)
    new = row("e2", 2.0, cfr=0.25)
    lines = compared_answer(
        [old],
        [new],
        atlases=(atlas(4, rear=1, oncoming=3), atlas(2, crossing=1, oncoming=1)),
        folder=tmp_path,
    )
    said = " ".join(" ".join(lines).split())
    assert (
        "in 4 of 12 scenes before training, in 2 ways, and in 2 of 12 scenes after it, in 2 ways"
        in said
    )
    assert "1 are gone, 1 are new" in said
    ways = [
        line.split()
        for line in lines
        if line.split()[:1] in (["oncoming"], ["rear"], ["crossing"])
    ]
    assert ways == [["oncoming", "3", "1"], ["rear", "1", "0"], ["crossing", "0", "1"]]
    milder = row("e2", 1.0, cfr=0.5)
    nominal = row("nominal", 0.0)
    rows = [old, milder, nominal]
    for atlases, shown in ((None, 3), ((atlas(0), atlas(0)), 2)):
        hits = [
            line
            for line in compared_answer(rows, rows, atlases=atlases, folder=tmp_path)
            if line.startswith("hit, ")
        ]
        assert len(hits) == shown, (
            "beside an atlas nominal traffic and the strongest attack"
        )
    none = compared_answer([old], [new], atlases=(atlas(0), atlas(0)), folder=tmp_path)
    assert "in 0 of 12 scenes before training" in " ".join(" ".join(none).split())


def test_rates_before_and_after_stand_with_their_ratio(tmp_path):
    old, new = ego_rates("actor", 3.0), ego_rates("actor")
    lines = compared_answer([], [], rates=(old, new), folder=tmp_path)
    said = " ".join(" ".join(lines).split())
    assert "preventable failures per 1,000 km before training, 50 [" in said
    assert "before over after 3 [3, 3]." in said


def test_a_ratio_to_no_failure_is_told_by_its_lower_end(tmp_path):
    old, new = ego_rates("actor", 3.0), ego_rates("actor", 0.0)
    lines = compared_answer([], [], rates=(old, new), folder=tmp_path)
    assert "before over after at least" in " ".join(" ".join(lines).split())


@pytest.mark.parametrize("width", [80, 100])
def test_it_fits_whatever_it_is_told(tmp_path, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    long = modes_of(
        *(
            mode(k, "crossing from the right, " * 6, count=300, counted=300)
            for k in (1, 2, 3)
        )
    )
    egos = [
        row(method, eta, ego=ego, cfr=0.5, n=9999)
        for ego in "uvwxyz"
        for method, eta in (("n", 0.0), ("ctg_adv", 2.5))
    ]
    notes = [
        "12 scenes left out: the ego overlaps another vehicle at the start of the recording."
    ] * 4
    pairs = [row(f"a_long_name_of_a_method_{k}", 1.0, cfr=0.5) for k in range(9)]
    ways = atlas(9, **{"crossing from the right, " * 9 + str(k): k for k in range(20)})
    answers = [
        answer_lines(rows, long, folder=tmp_path, report=None, notes=notes)
        for rows in (pairs[:1], egos, egos[:1])
    ]
    rates = (ego_rates("one"), ego_rates("one"))
    for lines in (
        *answers,
        *(
            compared_answer(pairs, pairs, atlases=item, rates=rates, folder=tmp_path)
            for item in (None, (ways, ways))
        ),
    ):
        assert len(lines) <= LINES
        assert all(len(line) <= width for line in lines if str(tmp_path) not in line)
        assert lines[-1].endswith("tables.md"), "where everything lies is never cut"


def test_preventable_failures_decide_then_clean_ones_then_those_that_count():
    rates = {"hits": 0.75, "clean": 0.5, "same": 0.5, "few": 0.25}
    rows = [row(name, 1.0, cfr=cfr) for name, cfr in rates.items()]
    for item, preventable, clean in zip(rows, (1, 4, 4, 3), (1, 2, 1, 3), strict=True):
        item["metrics"] |= {
            "cfr_preventable": value(preventable / 12),
            "cfr_clean": value(clean / 12),
        }
    lines = answer_lines(rows)
    assert [line.split()[0] for line in lines if " of 12)" in line] == [
        "clean",
        "same",
        "few",
        "hits",
    ]
    assert "rollouts, of them 4 preventable, 2 clean; 6 count." in " ".join(lines[:2])


def headed(found, **values):
    """A row of a search with a headline."""
    about = {
        "scenes": 12,
        "preventable": 5,
        "raised": 0,
        "failed": 5,
        "ways": 8,
        "searches": 1,
    }
    metrics = found["metrics"] | {
        "counted": value(0.5, 31),
        "at_fault": value(0.25, 31),
    }
    headline = about | {"tries": 4.25, "nfe": 630.4} | values
    return found | {
        "searched": True,
        "headline": headline,
        "metrics": metrics,
        "errored": {},
    }


def test_a_search_is_told_by_its_scenes_and_none_of_its_tries_rates():
    lines = answer_lines(
        [row(cfr=1 / 12), headed(row("search", 2.0, cfr=5 / 12))], MODES
    )
    text = " ".join(" ".join(lines).split())
    said = (
        "lane_graph under search at η=2: preventable failures in 5 of 12 scenes, "
        "in 8 ways, within 4.2 tries (630 NFE)"
    )
    assert text.startswith(said)
    assert "hit in 5 of 12 scenes" in text


def test_nominal_failures_are_not_among_those_of_an_attack():
    result = modes_of(
        mode(1, "rear", count=4, counted=1, nominal=3),
        mode(2, "oncoming", count=0, counted=0, nominal=5),
    )
    text = " ".join(answer_lines([row(cfr=8 / 12), row("e2", 2.0, cfr=4 / 12)], result))
    assert "rear (4 of 4 failures, 1 count)" in text
    assert "oncoming" not in text


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (3, "No weakness stands out: 3 failures that count"),
        (0, "although none of the contacts counts"),
    ],
)
def test_what_counts_is_not_denied(other, said):
    result = modes_of(
        mode(1, "rear", count=4, counted=0), mode(0, "other", count=5, counted=other)
    )
    assert said in " ".join(answer_lines([row("e2", 2.0, cfr=9 / 12)], result))


def test_rollouts_in_which_the_planner_raised_are_failures_and_named():
    crashed = row("e2", 2.0, cfr=9 / 12)
    crashed["metrics"]["errored"] = value(0.5)
    about = {
        "method": "e2",
        "eta": 2.0,
        "ego_policy": "lane_graph",
        "seed": 0,
        "errored": 1.0,
        "raised_by": "ego",
        "error": "KeyError: lane",
    }
    rollouts = [about | {"scene_id": f"place_{k}"} for k in range(6)]
    text = " ".join(" ".join(answer_lines([crashed], rollouts=rollouts)).split())
    assert "fails most in the traffic of e2 η=2: hit or raised in 9 of 12" in text
    text = " ".join(answer_lines([row("a", 1.0, cfr=0.5), crashed], rollouts=rollouts))
    assert (
        "Rates per 1,000 km are without 6 rollouts in which a planner raised."
        in " ".join(text.split())
    )
    assert (
        "KeyError: lane (6 under e2 at η=2): place_0 (seed 0), place_1 (seed 0)" in text
    )


@pytest.mark.parametrize("report", [None, Path("failures.html")])
def test_people_touched_are_told_and_named_where_there_is_no_page(report):
    """Although no vehicle was hit."""
    about = {
        "method": "e2",
        "eta": 2.0,
        "ego_policy": "lane_graph",
        "seed": 0,
        "errored": 0.0,
        "cfr": 0.0,
    }
    rollouts = [
        about | {"scene_id": f"place_{k}", "cfr_vru": float(k == 3), "cfr_object": 0.0}
        for k in range(12)
    ]
    text = " ".join(
        " ".join(
            answer_lines([row("e2", 2.0)], rollouts=rollouts, report=report)
        ).split()
    )
    assert "hit in 0 of 12 rollouts" in text
    assert "an object" not in text
    assert (
        "lane_graph touched a pedestrian or cyclist in 1 of 12 rollouts under e2 at η=2"
        in text
    )
    assert (
        (": place_3 (seed 0)." in text)
        == (report is None)
        == ("see cfr_vru in rollouts.csv" not in text)
    )


def test_people_touched_before_or_after_training_have_a_row():
    old = row("e2", 2.0)
    new = row("e2", 2.0)
    for item, rate in ((old, 0.25), (new, 0.0)):
        item["metrics"] |= {"cfr_vru": value(rate), "cfr_object": value(0.0)}
    lines = compared_answer([old], [new])
    (line,) = [line for line in lines if line.startswith("people touched")]
    assert "25% (3 of 12)" in line
    assert "0% (0 of 12)" in line
    assert not any("objects" in line for line in lines)
