"""`e2rl power --rate P --ratio R [--scenes N]`: how many scenes it takes to see that
failures became rarer, or what so many scenes can show (docs/guide/compare.md)."""

import argparse
import math

from e2rl.evaluation.power import ratio_seen, scenes_needed
from e2rl.run.endings import ending
from e2rl.run.errors import InputError


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="e2rl power", description=__doc__)
    parser.add_argument(
        "--rate",
        type=float,
        required=True,
        help="fraction of scenes with a failure before, such as 0.08",
    )
    parser.add_argument("--ratio", type=float, help="of the rate after to it, as 0.5")
    parser.add_argument("--scenes", type=int, help="that there are")
    parser.add_argument(
        "--correlation",
        type=float,
        default=0.0,
        help="of failures before and after in one scene (default: 0)",
    )
    parser.add_argument(
        "--power", type=float, default=0.8, help="chance to see it (default: 0.8)"
    )
    options = parser.parse_args(arguments)
    with ending():
        print(*answer(options), sep="\n")


def answer(options: argparse.Namespace) -> list[str]:
    """Returns what is printed. Raises InputError for neither a ratio nor scenes."""
    if options.ratio is None and options.scenes is None:
        raise InputError("e2rl power: give --ratio, --scenes, or both")
    about = {"correlation": options.correlation, "power": options.power}
    lines = []
    if options.ratio is not None:
        needed = scenes_needed(options.rate, options.ratio, **about)
        lines.append(
            f"{options.rate:g} to {options.rate * options.ratio:g} of scenes: seen with "
            f"{needed:,} scenes (95% interval of the difference without 0, with a chance "
            f"of {options.power:.0%})"
        )
    if options.scenes is not None:
        if options.scenes < 1:
            raise InputError(f"--scenes {options.scenes}: expected at least 1")
        ratio = ratio_seen(options.rate, options.scenes, **about)
        lines.append(
            f"{options.scenes:,} scenes are too few even to see {options.rate:g} vanish"
            if math.isnan(ratio)
            else f"{options.scenes:,} scenes show a fall to {ratio:.2f} times or less"
        )
    return lines
