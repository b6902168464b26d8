"""`e2rl rate [ego=NAME] [data=...]`: how often an ego fails in traffic as the prior has
it, with an interval, and which failures are the likeliest (docs/guide/rate.md).

Writes rates.json, rates.md and tail.csv, and of the failures that it draws what an
evaluation writes: rollouts.csv, rollouts/, metrics.json, modes.json, failures.html.
"""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
from e2rl.driving.scored import Scored
from e2rl.evaluation.plan import Evaluation, begin
from e2rl.evaluation.rates import EgoRates, write_rates
from e2rl.evaluation.record import record
from e2rl.report.html import write_report
from e2rl.report.rates import rate_tables, summary_lines
from e2rl.report.tables import save_tables
from e2rl.run.command import run_command
from e2rl.run.config import resolved, settings_of
from e2rl.run.errors import InputError
from e2rl.run.options import check_unused
from e2rl.run.run import Run
from e2rl.tail.rate import Rating
from e2rl.tail.settings import RateSettings
from e2rl.tail.summary import scene_rates
from e2rl.traffic.nominal import NominalTraffic

TABLES_FILE = "rates.md"
MAY_CHANGE = ("processes",)  # when a run is resumed
UNUSED = ("reproduce", "failure", "shard", "budget", "compare")  # keys of evaluations


def rate(run: Run) -> None:
    """Drive what is not on disk yet, write the rates, and print them."""
    config = run.config
    check_unused(config, "e2rl rate", UNUSED)
    if config.tries != 1:
        raise InputError(
            f"tries={config.tries}: rollouts are rate.rollouts; leave it out"
        )
    settings = settings_of(RateSettings, resolved(config.rate), where="rate")
    plan = begin(
        run,
        f"up to {settings.populations} x {settings.rollouts} rollouts a scene",
        times=settings.populations * settings.rollouts,
    )
    traffic = nominal_traffic(plan)
    (seed,) = plan.settings.seeds
    egos = []
    failures = Scored()
    for setup in plan.setups:
        rating = Rating(setup, traffic, settings, seed=seed)
        scenes = scene_rates(
            rating.estimates(plan.work), plan.scenes, target=settings.target
        )
        for scene in scenes:
            failures.add(scene.failures)
        egos.append(
            EgoRates.of(
                setup.ego_name,
                scenes,
                target=settings.target,
                least=settings.least,
                steps=plan.scenes.steps,
            )
        )
    write_rates(run.folder, egos, failures)
    tables = rate_tables(egos)
    save_tables(run.folder / TABLES_FILE, tables)
    lines = [line for ego in egos for line in summary_lines(ego)]
    lines += [f"\n{table.text()}" for table in tables]
    if failures.rows:
        drawn = record(
            failures, run.folder, config=run.config, searched=True, **plan.origin
        )
        if plan.settings.report and plan.settings.save_rollouts:
            page = write_report(run.folder, drawn, tables=tables)
            lines.append(f"\nIts failures: {page}")
    print("", *lines, f"Written to {run.folder}", sep="\n")


def nominal_traffic(plan: Evaluation) -> NominalTraffic:
    """Returns the traffic whose tail is drawn. Raises InputError for more or other
    traffic than one of the prior without control, and for several seeds."""
    traffic = [method.traffic for method in plan.methods]
    if len(plan.settings.seeds) != 1:
        raise InputError(
            f"seeds={list(plan.settings.seeds)}: one seed gives all draws; repetitions "
            "are rate.repetitions"
        )
    if len(traffic) != 1 or type(traffic[0]) is not NominalTraffic:
        names = ", ".join(map(str, plan.run.config.methods))
        raise InputError(
            f"methods=[{names}]: rates are of the prior's own traffic; leave "
            "methods=[nominal]"
        )
    return traffic[0]


def main() -> None:
    """The command."""
    run_command("rate", rate, may_change=MAY_CHANGE)
