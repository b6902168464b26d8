"""`e2rl rate [ego=NAME] [data=...]`: how often an ego fails in traffic as the prior has
it, with an interval, and which failures are the likeliest (docs/guide/rate.md).

Writes rates.json, rates.md, tail.csv and, of failures, rollouts.csv and rollouts/.
"""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
from e2rl.evaluation.plan import Evaluation, begin
from e2rl.report.rates import EgoRates, rate_lines, write_rates
from e2rl.run.command import run_command
from e2rl.run.config import resolved, settings_of
from e2rl.run.errors import InputError
from e2rl.run.run import Run
from e2rl.tail.rate import RateSettings, Rating
from e2rl.tail.summary import scene_rates
from e2rl.traffic.nominal import NominalTraffic

MAY_CHANGE = ("processes",)  # when a run is resumed


def rate(run: Run) -> None:
    """Drive what is not on disk yet, write the rates, and print them."""
    config = run.config
    settings = settings_of(RateSettings, resolved(config.rate), where="rate")
    plan = begin(
        run,
        f"up to {settings.repetitions} populations of {settings.rollouts} rollouts a scene",
    )
    traffic = nominal_traffic(plan)
    (seed,) = plan.settings.seeds
    egos = []
    for setup in plan.setups:
        rating = Rating(setup, traffic, settings, seed=seed)
        scenes = scene_rates(
            rating.estimates(plan.work), plan.scenes, target=settings.target
        )
        egos.append(
            EgoRates(
                setup.ego_name,
                scenes,
                target=settings.target,
                steps=plan.scenes.steps,
            )
        )
    write_rates(run.folder, egos)
    print("", *rate_lines(egos), f"written to {run.folder}", sep="\n")


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
        names = ", ".join(method.name for method in plan.methods)
        raise InputError(
            f"methods=[{names}]: rates are of the prior's own traffic; leave "
            "methods=[nominal]"
        )
    return traffic[0]


def main() -> None:
    """The command."""
    run_command("rate", rate, may_change=MAY_CHANGE)
