"""Tables: the order of the metrics, per cent, what is counted, what is unknown; in
Markdown, CSV and LaTeX."""

import csv
from types import SimpleNamespace

import pytest

from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.catalogue import METRICS, table_metrics
from e2rl.metrics.score import score_rollouts
from e2rl.report.comparison_tables import method_tables, planner_tables, save_compared
from e2rl.report.tables import Table, difference_cell, escaped, metric_tables, number
from tests.metrics.random_rollouts import random_rollouts

TERMS = {"e2": ("predicted", "full"), "ctg_adv": ("plan", "none"), "replay": ("", "")}


def rows_of(*drawn, rollouts=6, draws=50, **options):
    """Rows of metrics.json of (method, ego, eta), each of rollouts of its own."""
    rows = []
    samples = []
    for number_, (method, ego, eta) in enumerate(drawn):
        result, features = score_rollouts(random_rollouts(rollouts, seed=3 + number_))
        rows += [
            row | {"method": method, "ego_policy": ego, "eta": eta} for row in result
        ]
        samples += features
    return metric_rows(rows, samples, draws=draws, realism_draws=5, **options)


@pytest.fixture(scope="module")
def rows():
    return rows_of(("nominal", "idm", 0.0), ("e2", "idm", 2.0), rollouts=8)


def test_tables_list_known_metrics_in_the_catalogue_s_order(rows):
    for table, absent in (("main", ("avoidable", "transport")), ("traffic", ())):
        names = [
            row[0].split(" [")[0] for row in metric_tables(rows, table=table)[0].rows
        ]
        order = [
            metric.name for metric in table_metrics(table) if metric.name not in absent
        ]
        assert names == [name for name in order if name in names]
        assert {*names} >= {
            "cfr_bg",
            "real",
        }


def test_what_rests_on_fewer_rollouts_says_so(rows):
    means, _ = metric_tables(rows)
    (cells,) = (row[1:] for row in means.rows if row[0].startswith("relvel ["))
    for cell, row in zip(cells, rows, strict=True):
        certain = row["metrics"]["relvel"]["n"]
        assert cell.endswith(f"({certain})") if certain else cell == "–"


def test_numbers_keep_three_digits():
    share, metres, real = (METRICS[name] for name in ("cfr", "progress", "real"))
    assert [number(share, value) for value in (0.1234, 0.0012, 0.0, 1.0)] == [
        "12.3",
        "0.12",
        "0.0",
        "100.0",
    ]
    assert [number(metres, value) for value in (1234.4, 64.35, 3.14159, 0.01)] == [
        "1234",
        "64.3",
        "3.14",
        "0.010",
    ]
    assert number(real, 0.8764, sign="+") == "+0.876"
    declared = SimpleNamespace(fraction=False, decimals=3)
    assert [number(declared, value) for value in (1.0, 12.34)] == ["1.000", "12.340"]


# --- a row a method, a row an ego


@pytest.fixture(scope="module")
def methods():
    return method_tables(
        rows_of(*((name, "idm", 2.0) for name in TERMS)),
        TERMS,
        references=["e2", "replay"],
        settings="The prior.",
    )


def test_differences_are_paired_to_each_reference(methods):
    """A difference to the one is the opposite of the difference from it; a star marks
    intervals without 0."""
    means, differences = methods
    assert [row[:3] for row in means.rows[::2]] == [
        ["e2 η=2", "predicted", "full"],
        ["replay η=2", "–", "–"],
    ]
    cfr = differences.head.index("cfr [points]")
    position, back = (differences.rows[place][cfr].split(" ")[0] for place in (1, 2))
    assert float(position) == -float(back) != 0
    pairs = [(row[0], row[3]) for row in differences.rows]
    assert pairs == [
        ("ctg_adv η=2", "e2"),
        ("replay η=2", "e2"),
        ("e2 η=2", "replay"),
        ("ctg_adv η=2", "replay"),
    ]
    progress = METRICS["progress"]
    cells = [
        difference_cell(progress, {"difference": 3.0, "low": low, "high": 5.0})
        for low in (1.0, -1.0)
    ]
    assert [cell.endswith("*") for cell in cells] == [True, False]


def test_they_are_written_in_three_formats(methods, tmp_path):
    save_compared(tmp_path, methods)
    with (tmp_path / "methods.csv").open(newline="") as file:
        assert list(csv.reader(file)) == [methods[0].head, *methods[0].rows]
    latex = (tmp_path / "methods.tex").read_text()
    assert latex.count(r"\begin{tabular}") == latex.count(r"\bottomrule") == 2
    body = [line for line in latex.splitlines() if line.endswith(r"\\")]
    assert len(body) == 2 + 3 + 4
    assert {line.count(" & ") for line in body} == {
        len(table.head) - 1 for table in methods
    }
    assert r"cfr [\%]" in latex
    assert r"seconds\_per\_rollout" in latex
    assert r"$\eta$" in latex
    assert "a&#124;b" in Table("C.", ["", "x"], rows=[["a|b", "1"]]).markdown()
    assert (
        escaped("a_b & 5% {x} \\ 3 m/s²")
        == r"a\_b \& 5\% \{x\} \textbackslash{} 3 m/s$^2$"
    )


def test_every_ego_has_a_row_and_a_difference_to_the_reference():
    names = ["idm", "lane_graph", "actor"]
    pairs = [("idm", "lane_graph"), ("actor", "lane_graph")]
    rows = rows_of(*(("e2", name, 2.0) for name in names), egos=pairs)
    means, differences = planner_tables(rows, names, references=["lane_graph"])
    assert [row[:2] for row in means.rows] == [[ego, "e2 η=2"] for ego in names]
    assert [row[0] for row in differences.rows] == ["idm", "actor"]
    difference = rows[0]["paired"]["ego lane_graph"]["cfr"]["difference"]
    assert differences.rows[0][differences.head.index("cfr [points]")].startswith(
        f"{100 * difference:+.1f}"[:4]
    )
