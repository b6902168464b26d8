"""Rates of failures in traffic as the prior has it, in words and as tables."""

import math
from collections import Counter
from collections.abc import Sequence
from itertools import combinations

from e2rl.evaluation.rates import EgoRates
from e2rl.report.tables import UNKNOWN, Table
from e2rl.tail.interval import LEVEL, Bounds
from e2rl.tail.sampler import ALONE, EXTINCT, LEAST, REACHED, SPENT
from e2rl.tail.summary import UNITS

LIKELIEST = 10  # scenes whose failures are named
BUDGETS = (5, 10, 20, 50)  # nats
ENDS = {
    REACHED: "failures drawn",
    LEAST: "less likely than rate.least",
    SPENT: "rate.rollouts spent before one was drawn",
    EXTINCT: "all rollouts come equally near, so no further draws",
    ALONE: "nothing is left to chance",
}
WORDS = {"contact": "contacts", "preventable": "preventable failures"}  # of targets
NOTE = (
    "p is that of the prior, which is no road: what it makes of speeds, gaps and routes "
    "beside recordings stands in docs/results/prior.md."
)


def summary_lines(ego: EgoRates) -> list[str]:
    """Returns what the run says of an ego, in sentences."""
    rollouts = sum(scene["rollouts"] for scene in ego.scenes)
    reached = sum(scene["end"] == REACHED for scene in ego.scenes)
    rate = ego.rates[ego.target]["1000km"]
    return [
        f"{ego.ego} in traffic as the prior has it: {text(rate)} {WORDS[ego.target]} "
        "per 1,000 km.",
        f"They were drawn in {reached} of {len(ego.scenes)} scenes, by {rollouts:,} "
        "rollouts.",
    ]


def rate_tables(egos: Sequence[EgoRates]) -> list[Table]:
    """Returns the tables of rates, ratios, nats, likeliest failures and ends."""
    rates = [
        [ego.ego, event, *(text(units[unit]) for unit in UNITS)]
        for ego in egos
        for event, units in ego.rates.items()
    ]
    tables = [
        Table(
            f"Rates [95% interval, over places and repetitions; of ten or more]. {NOTE}",
            ["ego", "event", "a scene", "an hour", "1,000 km"],
            rows=rates,
        )
    ]
    pairs = [
        [first.ego, second.ego, event, text(first.ratio_to(second, event))]
        for first, second in combinations(egos, 2)
        for event in dict.fromkeys(("contact", first.target))
    ]
    if pairs:
        head = ["ego", "over", "event", "ratio per km"]
        tables.append(Table("Ratios of rates, paired by scene.", head, rows=pairs))
    tables.append(nats_table(egos))
    tables += [table for table in map(likeliest_table, egos) if table.rows]
    ends = [
        [ego.ego, ENDS.get(end, end), str(count)]
        for ego in egos
        for end, count in Counter(scene["end"] for scene in ego.scenes).items()
    ]
    tables.append(
        Table("How the first populations ended.", ["ego", "end", "scenes"], rows=ends)
    )
    return tables


def nats_table(egos: Sequence[EgoRates]) -> Table:
    """Returns in how many scenes a failure costs at most some nats."""
    from scipy import stats  # takes half a second to load

    rows = []
    for ego in egos:
        count = len(ego.scenes)
        for budget in BUDGETS:
            if math.exp(-budget) < ego.least:
                break
            hits = sum(scene["nats"] <= budget for scene in ego.scenes)
            interval = stats.binomtest(hits, count).proportion_ci(LEVEL, "wilson")
            share = f"{hits / count:.0%} [{interval.low:.0%}, {interval.high:.0%}]"
            rows.append([ego.ego, str(budget), f"{hits} of {count}", share])
    return Table(
        "Scenes in which a failure costs at most so many nats, -log p: the least that any "
        "control of the traffic spends on it.",
        ["ego", "nats", "scenes", "share"],
        rows=rows,
    )


def likeliest_table(ego: EgoRates) -> Table:
    """Returns the scenes with an ego's likeliest failures."""
    total = sum(scene["probability"] for scene in ego.scenes)
    rows = [
        [
            scene["scene_id"],
            text(Bounds(scene["probability"], scene["low"], scene["high"])),
            f"{abs(scene['nats']):.1f}",
            f"{scene['probability'] / total:.0%}",
            str(scene["failures"]),
            str(scene["rollouts"]),
        ]
        for scene in ego.scenes[:LIKELIEST]
        if scene["probability"] > 0
    ]
    return Table(
        f"{ego.ego}: where {WORDS[ego.target]} are likeliest; share of all scenes' "
        "probability.",
        ["scene", "p", "nats", "share", "failures drawn", "rollouts"],
        rows=rows,
    )


def text(bounds: Bounds) -> str:
    """Returns an estimate with its interval."""
    if math.isnan(bounds.value):
        return UNKNOWN
    value = number(bounds.value, digits=3)
    if math.isnan(bounds.low):
        return value
    return f"{value} [{number(bounds.low)}, {number(bounds.high)}]"


def number(value: float, digits: int = 2) -> str:
    """Returns a number with some digits, from 100 on with all before the point."""
    return f"{value:,.0f}" if 100 <= value < math.inf else f"{value:.{digits}g}"
