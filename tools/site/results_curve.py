"""python tools/site/results_curve.py: docs/assets/results.png, the table of
docs/intensity.md as a curve."""

import re
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt  # noqa: E402

DOCS = Path(__file__).resolve().parents[2] / "docs"
ROWS = {"cfr": ("failures", "tab:red"), "cfr_preventable": ("preventable", "tab:blue")}


def values(name: str) -> list[tuple[float, float, float]]:
    """(mean, low, high) in % at each intensity of a row of the first table that has it."""
    row = re.findall(
        rf"^\| `{name}` \|(.*)\|$", (DOCS / "intensity.md").read_text(), re.MULTILINE
    )[0]
    return [
        tuple(map(float, re.findall(r"[\d.]+", cell))) for cell in row.split("|")[:4]
    ]  # type: ignore[misc]


def main() -> None:
    fig, ax = plt.subplots(figsize=(5.6, 3.2), dpi=110)
    for shift, (name, (label, colour)) in zip((-0.02, 0.02), ROWS.items(), strict=True):
        mean, low, high = zip(*values(name), strict=True)
        eta = [step + shift for step in range(len(mean))]
        below, above = (
            [abs(a - b) for a, b in zip(mean, end, strict=True)] for end in (low, high)
        )
        ax.errorbar(
            eta, mean, [below, above], label=label, color=colour, marker="o", capsize=3
        )
    ax.set(xlabel="intensity η", ylabel="rollouts, %", xticks=range(4), ylim=(0, None))
    ax.set_title("lane_graph under e2, Waymo tune, 166 rollouts a point", fontsize=9)
    ax.legend(frameon=False)
    ax.spines[["top", "right"]].set_visible(False)
    fig.tight_layout()
    fig.savefig(DOCS / "assets" / "results.png")


if __name__ == "__main__":
    main()
