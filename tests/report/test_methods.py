"""Tables of methods and of egos: a row each, differences to one of them, in markdown, CSV and LaTeX."""

import csv

import pytest

from e2rl.evaluation.rollout_files import Source, label_rows
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.score import score_rollouts
from e2rl.report.comparison_tables import EGOS, method_tables, planner_tables, save_compared
from e2rl.report.tables import escaped
from tests.metrics.random_rollouts import random_rollouts

TERMS = {"e2": ("predicted", "full"), "ctg_adv": ("plan", "none"), "replay": ("", "")}


@pytest.fixture(scope="module")
def tables():
    labelled, features = [], []
    for number, name in enumerate(TERMS):
        rows, samples = score_rollouts(random_rollouts(6, seed=number))
        labelled += label_rows(rows, Source("synthetic", "test", name, "idm"))
        features += samples
    return method_tables(
        metric_rows(labelled, features, draws=50, realism_draws=5), TERMS, ["e2", "replay"], "The bundled prior."
    )


def test_every_method_has_a_row_with_its_terms_and_its_cost(tables):
    means = tables[0]
    assert [row[:3] for row in means.rows] == [
        ["e2 η=2", "predicted", "full"],
        ["ctg_adv η=2", "plan", "none"],
        ["replay η=2", "–", "–"],
    ]
    cost = {head: means.rows[0][place] for place, head in enumerate(means.head)}
    assert cost["passes"].startswith("128") and "seconds_per_rollout [s]" in cost and "[" in cost["cfr [%]"]
    assert "The bundled prior." in means.caption and "6 rollouts per method" in means.caption


def test_differences_are_paired_to_each_reference(tables):
    """A difference to the one is the opposite of the difference from it."""
    means, differences = tables
    cfr = differences.head.index("cfr [points]")
    there, back = (differences.rows[place][cfr].split(" ")[0] for place in (1, 2))
    assert float(there) == -float(back) != 0
    pairs = [(row[0], row[3]) for row in differences.rows]
    assert pairs == [("ctg_adv η=2", "e2"), ("replay η=2", "e2"), ("e2 η=2", "replay"), ("ctg_adv η=2", "replay")]
    assert "Difference of each method to e2 and to replay" in differences.caption and "cfr [points]" in differences.head
    assert len(differences.head) == len(means.head) + 1


def test_they_are_written_in_three_formats(tables, tmp_path):
    save_compared(tmp_path, tables)
    names = ["methods.csv", "methods.md", "methods.tex", "methods_differences.csv"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    with (tmp_path / "methods.csv").open(newline="") as file:
        assert list(csv.reader(file)) == [tables[0].head, *tables[0].rows]
    latex = (tmp_path / "methods.tex").read_text()
    assert latex.count(r"\begin{tabular}") == latex.count(r"\bottomrule") == 2
    body = [line for line in latex.splitlines() if line.endswith(r"\\")]
    assert len(body) == 2 + 3 + 4
    assert {line.count(" & ") for line in body} == {len(table.head) - 1 for table in tables}
    assert r"cfr [\%]" in latex and r"seconds\_per\_rollout" in latex and r"$\eta$" in latex


@pytest.fixture(scope="module")
def egos():
    """Table 4 of three egos under e2, of which the second is the reference."""
    labelled, features = [], []
    for number, ego in enumerate(("idm", "lane_graph", "actor")):
        rows, samples = score_rollouts(random_rollouts(6, seed=number))
        labelled += label_rows(rows, Source("synthetic", "test", "e2", ego))
        features += samples
    pairs = [("idm", "lane_graph"), ("actor", "lane_graph")]
    rows = metric_rows(labelled, features, draws=50, realism_draws=5, egos=pairs)
    return rows, planner_tables(rows, ["idm", "lane_graph", "actor"], "lane_graph")


def test_every_ego_has_a_row_and_a_difference_to_the_reference(egos):
    rows, (means, differences) = egos
    assert [row[:2] for row in means.rows] == [[ego, "e2 η=2"] for ego in ("idm", "lane_graph", "actor")]
    assert [row[0] for row in differences.rows] == ["idm", "actor"]
    difference = rows[0]["paired"]["ego lane_graph"]["cfr"]["difference"]
    assert differences.rows[0][differences.head.index("cfr [points]")].startswith(f"{100 * difference:+.1f}"[:4])


def test_a_first_contact_is_counted_at_one_side_and_at_all_that_touch(egos):
    """front, side and rear share the failures out; a contact at a corner is in two of front_any, side_any, rear_any."""
    rows, (means, _) = egos
    assert {f"{side}{of} [%]" for side in ("front", "side", "rear") for of in ("", "_any")} <= set(means.head)
    for row in rows:
        value = {name: found["mean"] for name, found in row["metrics"].items()}
        assert value["cfr"] > 0 and value["front"] + value["side"] + value["rear"] == pytest.approx(value["cfr"])
        assert all(value[f"{side}_any"] >= value[side] for side in ("front", "side", "rear"))


def test_the_tables_of_egos_have_files_of_their_own(egos, tmp_path):
    save_compared(tmp_path, egos[1], EGOS)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "egos.csv",
        "egos.md",
        "egos.tex",
        "egos_differences.csv",
    ]


def test_latex_has_no_sign_that_it_would_read_as_a_command():
    assert escaped("a_b & 5% {x} ~ \\ 3 m/s²") == (r"a\_b \& 5\% \{x\} \textasciitilde{} \textbackslash{} 3 m/s$^2$")
