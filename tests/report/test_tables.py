"""Tables: the order of the metrics, per cent, what is counted, and what is unknown."""

import math
from types import SimpleNamespace

import pytest

from e2rl.evaluation.rollout_files import Source, label_rows
from e2rl.evaluation.summary import metric_rows
from e2rl.metrics.catalogue import MAIN, TABLES
from e2rl.metrics.score import score_rollouts
from e2rl.report.tables import metric_tables, number, print_tables, save_tables
from tests.metrics.random_rollouts import random_rollouts


@pytest.fixture(scope="module")
def rows():
    scores, features = score_rollouts(random_rollouts(8, seed=3))
    other, more = score_rollouts(random_rollouts(8, seed=4))
    labelled = label_rows(other, Source("synthetic", "test", "nominal", "idm"))
    labelled = [row | {"eta": 0.0} for row in labelled] + label_rows(scores, Source("synthetic", "test", "e2", "idm"))
    return metric_rows(labelled, more + features, draws=50, realism_draws=5)


def test_tables_list_known_metrics_in_the_catalogue_s_order(rows):
    means, paired = metric_tables(rows)
    assert means.head == ["", "nominal", "e2 η=2"] and paired.head == ["", "e2 η=2"]
    names = [row[0].split(" [")[0] for row in means.rows]
    assert names == [metric.name for metric in MAIN if metric.name not in ("avoidable", "transport")]
    traffic = [row[0].split(" [")[0] for row in metric_tables(rows, table="traffic")[0].rows]
    assert traffic == [name for name in TABLES["traffic"] if name in traffic] and "w1_jerk" in traffic


def test_a_sweep_names_every_intensity(rows):
    scores, features = score_rollouts(random_rollouts(4, seed=5))
    labelled = [
        row | {"eta": eta} for eta in (0.0, 2.0) for row in label_rows(scores, Source("synthetic", "test", "e2", "idm"))
    ]
    means, paired = metric_tables(metric_rows(labelled, features * 2, draws=5, realism_draws=2))
    assert means.head == ["", "e2 η=0", "e2 η=2"] and paired.head == ["", "e2 η=2"]
    assert "Difference to e2 η=0" in paired.caption


def test_rates_are_per_cent_with_their_interval(rows):
    means, paired = metric_tables(rows)
    value = rows[1]["metrics"]["cfr_bg"]
    (row,) = (row for row in means.rows if row[0] == "cfr_bg [%]")
    assert row[2].startswith(f"{100 * value['mean']:.1f} [")
    assert paired.rows[0][0] == "cfr [points]" and paired.rows[0][1][0] in "+-"


def test_captions_say_how_much_a_table_is_computed_from(rows):
    caption = metric_tables(rows, settings="16 samples, 20 network passes.")[0].caption
    assert "4 scenes, 2 seeds, 8 rollouts per method" in caption and "16 samples, 20 network passes." in caption
    assert "Not computable here: avoidable, transport." in caption


def test_values_on_fewer_rollouts_carry_their_count(rows):
    cells = {row[0].split(" [")[0]: row[1:] for row in metric_tables(rows)[0].rows}
    for column, row in enumerate(rows):
        known = row["metrics"]["relvel"]["n"]
        assert cells["relvel"][column].endswith(f"({known})") if known else cells["relvel"][column] == "–"


def test_tables_are_printed_and_saved_as_markdown(rows, tmp_path, capsys):
    tables = metric_tables(rows)
    print_tables(tables)
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("cfr [%]") for line in lines)
    save_tables(tmp_path / "tables.md", tables)
    text = (tmp_path / "tables.md").read_text()
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in table[: len(tables[0].rows) + 2]} == {4}


def test_numbers_keep_three_digits():
    share, metres, real = (next(m for m in MAIN if m.name == name) for name in ("cfr", "progress", "real"))
    assert [number(share, value) for value in (0.1234, 0.0012, 0.0, 1.0)] == ["12.3", "0.12", "0.0", "100.0"]
    assert [number(metres, value) for value in (1234.4, 64.35, 3.14159, 0.01)] == ["1234", "64.3", "3.14", "0.010"]
    assert number(real, 0.8764, "+") == "+0.876"
    declared = SimpleNamespace(share=False, decimals=3)
    assert [number(declared, value) for value in (1.0, 12.34)] == ["1.000", "12.340"]


def test_one_rollout_makes_a_table_without_intervals():
    scores, features = score_rollouts(random_rollouts(1, seed=3))
    rows = metric_rows(label_rows(scores, Source("synthetic", "test", "e2", "idm")), features, draws=5, realism_draws=2)
    (table,) = metric_tables(rows)
    assert "1 scene, 1 seed, 1 rollout per method" in table.caption
    assert math.isnan(rows[0]["metrics"]["progress"]["low"])
    assert "[" not in next(row for row in table.rows if row[0].startswith("progress"))[1]
