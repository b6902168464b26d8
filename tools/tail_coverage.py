"""`python tools/tail_coverage.py [--probability P ...] [--numbers D]`: how often the
intervals of `e2rl rate` hold failures of known probability, and what they cost.

Each repetition is what the command does in one scene: populations of the settings of
conf/rate.yaml, and the interval of their estimates. Prints a table.
"""

import argparse
import sys
from dataclasses import fields, replace
from pathlib import Path

import torch
import yaml
from tabulate import tabulate

from e2rl.run.cpu import configure_cpu
from e2rl.tail.sampler import REACHED, SamplerSettings
from e2rl.tail.summary import target_bounds

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from tests.tail.closed_forms import FORMS, tally  # noqa: E402 - of the path above

ERROR = 0.3  # relative, at which costs are compared
HEAD = ["failure", "p", "held", "mean of p", "sd", "rollouts", "of 30%", "plain"]


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--probability", type=float, nargs="+", default=[1e-3, 1e-6])
    parser.add_argument("--numbers", type=int, default=10_000, help="standard normals")
    parser.add_argument("--repetitions", type=int, default=100, help="of an interval")
    parser.add_argument("--moves", type=int, help="of each copy (conf/rate.yaml's)")
    parser.add_argument("--form", choices=FORMS, action="append")
    options = parser.parse_args(arguments)
    configure_cpu(1)
    rate = yaml.safe_load((ROOT / "conf/rate.yaml").read_text())["rate"]
    names = [field.name for field in fields(SamplerSettings)]
    settings = SamplerSettings(**{name: rate[name] for name in names})
    settings = replace(
        settings,
        rollouts=100_000,
        least=1e-12,
        moves=options.moves or settings.moves,
    )
    rows = []
    for probability in options.probability:
        for form in options.form or FORMS:
            row = coverage(form, probability, settings, rate["repetitions"], options)
            rows.append(row)
            print(*row, sep=", ", flush=True)
    print(tabulate(rows, HEAD, "pipe", disable_numparse=True))


def coverage(
    form: str,
    probability: float,
    settings: SamplerSettings,
    populations: int,
    options: argparse.Namespace,
) -> list[str]:
    """Returns the row of a failure: intervals that hold its probability, mean and
    relative standard deviation of a population's estimate, its rollouts, and those
    that an error of 30% takes, beside independent rollouts."""
    level, threshold = FORMS[form]
    target = threshold(probability)
    held = 0
    estimates = []
    rollouts = 0
    for repetition in range(options.repetitions):
        tallies = [
            tally(
                level,
                target,
                numbers=options.numbers,
                seed=repetition * populations + population,
                settings=settings,
            )
            for population in range(populations)
        ]
        values = torch.tensor([part.probability for part in tallies]).double()
        open_ends = [0.0 if part.end == REACHED else part.bound for part in tallies]
        bounds = target_bounds(values, torch.tensor(open_ends).double())
        held += bounds.low <= probability <= bounds.high
        estimates.append(values / probability)
        rollouts += sum(part.rollouts for part in tallies)
    relative = torch.cat(estimates)
    deviation = float(relative.std())
    each = rollouts / len(relative)
    return [
        form,
        f"{probability:g}",
        f"{held} of {options.repetitions}",
        f"{float(relative.mean()):.2f}",
        f"{deviation:.2f}",
        f"{each:.0f}",
        f"{each * (deviation / ERROR) ** 2:,.0f}",
        f"{(1 - probability) / probability / ERROR**2:,.0f}",
    ]


if __name__ == "__main__":
    main(sys.argv[1:])
