"""The table of methods: a row each, what it knows and owes, differences to one, in markdown, CSV and LaTeX."""

import csv

import pytest

from e2rl.evaluation.files import Source, label_rows
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.score import score_rollouts
from e2rl.report.methods import method_tables, save_method_tables
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
    return method_tables(metric_rows(labelled, features, draws=50, realism_draws=5), TERMS, "e2", "The bundled prior.")


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


def test_differences_are_paired_to_the_reference(tables):
    means, differences = tables
    assert [row[0] for row in differences.rows] == ["ctg_adv η=2", "replay η=2"]
    assert "Difference of each method to e2" in differences.caption and "cfr [points]" in differences.head
    assert len(differences.head) == len(means.head)


def test_they_are_written_in_three_formats(tables, tmp_path):
    save_method_tables(tmp_path, tables)
    names = ["methods.csv", "methods.md", "methods.tex", "methods_differences.csv"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    with (tmp_path / "methods.csv").open(newline="") as file:
        assert list(csv.reader(file)) == [tables[0].head, *tables[0].rows]
    latex = (tmp_path / "methods.tex").read_text()
    assert latex.count(r"\begin{tabular}") == latex.count(r"\bottomrule") == 2
    body = [line for line in latex.splitlines() if line.endswith(r"\\")]
    assert len(body) == 2 + 3 + 2 and {line.count(" & ") for line in body} == {len(tables[0].head) - 1}
    assert r"cfr [\%]" in latex and r"seconds\_per\_rollout" in latex and r"$\eta$" in latex


def test_latex_has_no_sign_that_it_would_read_as_a_command():
    assert escaped("a_b & 5% {x} ~ \\ 3 m/s²") == (r"a\_b \& 5\% \{x\} \textasciitilde{} \textbackslash{} 3 m/s$^2$")
