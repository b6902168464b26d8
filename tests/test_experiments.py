"""The experiments of evaluate.py on tiny runs: their rows, tables, figures and files."""

import csv
import sys

import pytest

from e2rl.evaluation.rollout_files import read_metrics
from e2rl.metrics.catalogue import COMPUTE, METRICS
from tests.scripts import SHORT, arguments, call

pytestmark = pytest.mark.slow  # whole runs


@pytest.fixture
def evaluated(world, tmp_path, monkeypatch, capsys):
    """Runs evaluate.py with options on two short bundled scenes in tmp_path / "run",
    its folder. Metrics of plugins are unknown to the tests after this one, whose
    workers would not have them."""

    def run(*options):
        inputs = [
            *SHORT,
            f"data.cache={world / 'bundled'}",
            "seeds=[0]",
            f"hydra.run.dir={tmp_path / 'run'}",
        ]
        named = {option.partition("=")[0] for option in options}
        rest = [option for option in inputs if option.partition("=")[0] not in named]
        status, said = call(
            "evaluate.py", [*rest, *options], monkeypatch=monkeypatch, capsys=capsys
        )
        assert status == 0, said
        return tmp_path / "run"

    certain = METRICS.copy(), COMPUTE.copy()
    yield run
    for registered, before in zip((METRICS, COMPUTE), certain, strict=True):
        registered.clear()
        registered.update(before)
    sys.modules.pop("e2rl.metrics.nuplan", None)


def test_the_dial_has_a_row_for_every_eta(evaluated):
    """Two of the bundled scenes with the bundled prior."""
    run = evaluated("experiment=intensity")
    rows = read_metrics(run / "metrics.json")
    assert [(row["method"], row["eta"]) for row in rows] == [
        ("e2", eta) for eta in range(4)
    ]
    assert all(
        (row["n_scenes"], row["n_rollouts"], len(row["paired"])) == (2, 2, 3)
        for row in rows
    )
    assert [row["metrics"]["real_adv"]["n"] > 0 for row in rows] == [
        False,
        True,
        True,
        True,
    ]
    assert len(list((run / "rollouts").glob("*.npz"))) == 8


def test_nuplan_s_scores_are_a_table_of_their_own(evaluated):
    """The recorded ego in its own recording drives all of its way, hits nobody, and is
    within 1 m of the road."""
    run = evaluated("experiment=nuplan", "methods=[replay,idm]", "ego=replay")
    rows = {row["method"]: row["metrics"] for row in read_metrics(run / "metrics.json")}
    for method in ("replay", "idm"):
        assert rows[method]["ego_progress_along_expert_route"]["mean"] > 0.99
        assert 0 < rows[method]["nuplan_score"]["mean"] <= 1
    assert rows["replay"]["no_ego_at_fault_collisions"]["mean"] == 1
    assert "| nuplan_score [%]" in (run / "tables.md").read_text()


def test_the_public_protocol_has_crash_rates_and_route_completion_of_every_ego(
    evaluated,
):
    overrides = [
        "experiment=public_protocol",
        "methods=[replay,cat]",
        "egos.policy.checkpoint=bundled",
    ]
    run = evaluated(*overrides)
    head, *rows = (run / "egos.csv").read_text().splitlines()
    names = ["replay", "idm", "lane_graph", "untrained", "policy"]
    assert [row.split(",")[:2] for row in rows] == [
        [ego, name] for ego in names for name in ("replay", "cat η=2")
    ]
    assert head.startswith("ego,traffic,cfr [%]")
    log = rows[0].split(",")[head.split(",").index("route_completion [%]")]
    assert float(log.split()[0]) > 99, (
        "the recorded ego in recorded traffic drives all of its way"
    )


def test_a_budget_has_a_row_for_the_search_and_for_every_rival(evaluated):
    """As its authors have it, and with one sample."""
    run = evaluated("experiment=budget", "methods=[search,nominal]", "budget=40")
    rows = read_metrics(run / "metrics.json")
    samples = ("ccdiff", "ctg_adv", "safe_sim_opt", "diffscene")
    names = ["search", "nominal", *(f"{name}, one sample" for name in samples)]
    assert [row["method"] for row in rows] == names
    assert all(row["searched"] for row in rows)
    with (run / "tries.csv").open(newline="") as file:
        tried = {line["method"] for line in csv.DictReader(file)}
    assert tried == set(names)


def test_egos_before_and_after_are_rated_in_one_run(evaluated):
    """An untrained actor and a planner in its place."""
    egos = (
        "+egos.before={ego: actor}",
        "+egos.after={ego: lane_graph}",
    )
    run = evaluated("methods=[nominal,e2]", *egos)
    rows = read_metrics(run / "metrics.json")
    assert [(row["ego"], row["method"]) for row in rows] == [
        (ego, method) for ego in ("before", "after") for method in ("nominal", "e2")
    ]
    assert {key for row in rows[2:] for key in row["paired"]} == {
        "e2",
        "nominal",
        "ego before",
    }
    text = (run / "tables.md").read_text()
    assert "Difference of each ego to before" in text


def test_table_4_has_a_row_for_every_ego_in_three_formats(evaluated):
    run = evaluated("experiment=table4")
    head, *rows = (run / "egos.csv").read_text().splitlines()
    names = [
        "replay",
        "idm",
        "lane_graph",
        "sampling",
        "pdm_closed",
        "lane_graph_tuned",
        "bits",
    ]
    names += ["actor_untrained", "actor"]
    assert [row.split(",")[:2] for row in rows] == [[name, "e2 η=2"] for name in names]
    columns = (
        "cfr",
        "cfr_counted",
        "cfr_preventable",
        "front",
        "side",
        "rear",
        "front_any",
        "side_any",
        "rear_any",
    )
    assert head.startswith("ego,traffic,")
    assert all(f"{name} [%]" in head.split(",") for name in columns)
    for suffix in ("md", "tex"):
        assert "Difference of each ego to lane" in (run / f"egos.{suffix}").read_text()
    differences = (run / "egos_differences.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in differences[1:]] == [
        name for name in names if name != "lane_graph"
    ]
    assert "## Egos" in (run / "tables.md").read_text()


def test_a_folder_of_somebody_else_adds_methods_to_the_table(
    world, tmp_path, monkeypatch, capsys
):
    (tmp_path / "conf" / "synthesizer").mkdir(parents=True)
    text = "_target_: e2rl.traffic.rule_based.ConstantVelocity\nname: straight\n"
    (tmp_path / "conf" / "synthesizer" / "straight.yaml").write_text(text)
    overrides = [
        f"--config-dir={tmp_path / 'conf'}",
        *arguments(
            world,
            tmp_path,
            "good",
            "data.build.steps=20",
            "methods=[replay,straight]",
            "seeds=[0]",
        ),
    ]
    status, said = call(
        "evaluate.py", overrides, monkeypatch=monkeypatch, capsys=capsys
    )
    assert status == 0, said
    rows = read_metrics(tmp_path / "run" / "metrics.json")
    assert [(row["method"], row["eta"]) for row in rows] == [
        ("replay", 0),
        ("straight", 0),
    ]


def test_one_scene_is_driven_as_among_all(evaluated, tmp_path):
    result = []
    for which in ("scene=null", "scene=1"):
        folder = tmp_path / which
        evaluated(
            "seeds=[1]", "methods=[e2]", which, "batch=1", f"hydra.run.dir='{folder}'"
        )
        result.append(
            {
                path.name: path.read_bytes()
                for path in (folder / "rollouts").glob("*.npz")
            }
        )
    assert len(result[0]) == 2
    assert len(result[1]) == 1
    assert result[1].items() <= result[0].items()
