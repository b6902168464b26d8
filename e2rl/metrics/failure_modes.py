"""Failures grouped into modes: the few ways in which a planner fails (docs/reference/metrics.md).

A failure is a row of `score_rollouts` with a collision of the ego. Two failures are as
far apart as the sum of the weights of what differs: from where the partner came, what
both did, who was hit where, which duty was broken, how fast both were. Clusters of
average linkage are cut at the distance THRESHOLD: another kind of approach, or another
duty, makes a mode of its own, a single manoeuvre does not.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import cdist, pdist

from e2rl.metrics.catalogue import Metric, declare

Row = Mapping[str, Any]
THRESHOLD = 1.0  # mean distance of two groups of failures up to which they are one mode
SPEED_WEIGHT = 0.025  # of a difference of 1 m/s
AGREED = 2 / 3  # fraction of a mode's failures that a word of its name is true of
# Failures that a mode has at least: a fraction of all, and two where there are MANY.
LEAST = 0.02
MANY = 10
SIDE = re.compile(r"(?: from the| on the)? (left|right)$")
SPEEDS = ("ego_speed", "partner_speed")
PLACES = 10  # at which `mode_coverage` looks: failures at fewer places give none

_coverage = partial(
    Metric,
    decimals=1,
    column="mode",
    places=PLACES,
    per_collision=True,
    tables="adversaries",
)
declare(
    _coverage(
        "mode_coverage", f"failure modes expected of collisions at {PLACES} places"
    ),
    _coverage(
        "mode_coverage_counted",
        "the same, of collisions that count",
        weight="counted",
    ),
)


# Columns of words: how far apart two failures are whose words differ in kind, in side.
FEATURES = {
    "approach": (2.0, 0.5),
    "duty": (1.0, 0.0),
    "partner_manoeuvre": (0.5, 0.25),
    "ego_manoeuvre": (0.5, 0.25),
    "contact_type": (0.25, 0.0),
}


def is_failure(row: Row) -> bool:
    """Whether the row has a collision of the ego whose approach is known."""
    return row["cfr"] == 1 and bool(word(row, "approach"))


def word(row: Row, column: str) -> str:
    """The row's word in a column, "" where it has none."""
    value = row.get(column, "")
    return value if isinstance(value, str) else ""


def split_side(text: str) -> tuple[str, str]:
    """Kind and side of a word: ("crossing", "left") of "crossing from the left",
    ("brakes", "") of "brakes"."""
    match = SIDE.search(text)
    return (text[: match.start()], match.group(1)) if match else (text, "")


def known_features(failures: Sequence[Row]) -> list[str]:
    """The FEATURES that at least one failure has a word of; the others play no part."""
    return [column for column in FEATURES if any(word(row, column) for row in failures)]


def feature_vectors(failures: Sequence[Row]) -> np.ndarray:
    """Vectors [n, F] of failures, whose distance is the sum of absolute differences:
    indicators of each word's kind and side, with half of their weight (two of them
    change), and weighted speeds (unknown: the mean of the others)."""
    columns = []
    for column in known_features(failures):
        words = [split_side(word(row, column)) for row in failures]
        for part, weight in enumerate(FEATURES[column]):
            for value in sorted({pair[part] for pair in words}):
                columns.append([weight / 2 * (pair[part] == value) for pair in words])
    for name in SPEEDS:
        speeds = np.array([float(row.get(name, math.nan)) for row in failures])
        finite = speeds[~np.isnan(speeds)]
        speeds[np.isnan(speeds)] = finite.mean() if len(finite) else 0.0
        columns.append(list(SPEED_WEIGHT * speeds))
    return np.array(columns).T


def cluster_failures(failures: Sequence[Row]) -> list[int]:
    """The mode of each failure, numbered from 1 by size. The order of the failures does
    not matter."""
    if not failures:
        return []
    vectors = feature_vectors(failures)
    order = sorted(
        range(len(failures)),
        key=lambda index: (*vectors[index], *identity(failures[index])),
    )
    labels = [1]
    if len(order) > 1:
        tree = linkage(pdist(vectors[order], "cityblock"), "average")
        labels = fcluster(tree, THRESHOLD * (1 + 1e-9), "distance").tolist()
    sizes = Counter(
        labels
    )  # keeps the order of first appearance, which decides between equal sizes
    number = {
        cluster: place for place, (cluster, _) in enumerate(sizes.most_common(), 1)
    }
    return [
        number[cluster]
        for _, cluster in sorted(
            zip(
                order,
                labels,
                strict=True,
            )
        )
    ]


def large_modes(modes: Sequence[int]) -> list[int]:
    """The numbers, of the modes of all failures, that are worth a sentence each; the
    others are too small."""
    least = max(LEAST * len(modes), 2 if len(modes) >= MANY else 1)
    return sorted(mode for mode, count in Counter(modes).items() if count >= least)


def identity(row: Row) -> tuple[str, ...]:
    """What tells a row from all others of a run, as text."""
    return tuple(
        str(row.get(name, ""))
        for name in ("method", "eta", "ego_policy", "scene_id", "seed")
    )


def medoid(members: Sequence[Row]) -> int:
    """Position of the failure that is nearest to all members: the most typical one."""
    vectors = feature_vectors(members)
    order = sorted(range(len(members)), key=lambda index: identity(members[index]))
    far = cdist(vectors, vectors, "cityblock").sum(1)
    return min(order, key=lambda index: round(far[index], 9))


def mode_name(members: Sequence[Row]) -> str:
    """A sentence of the words that are true of most members, such as "crossing from the
    right, partner turns left, ego keeps speed: right of way". What they do not agree on
    is left out, and so is a duty that no row knows."""
    who = {"approach": "", "partner_manoeuvre": "partner ", "ego_manoeuvre": "ego "}
    parts = [
        whose + text
        for column, whose in who.items()
        if (text := agreed_word(members, column))
    ]
    named = ", ".join(parts) or "various"
    duty = agreed_word(members, "duty")
    return named + (
        f": {'no duty broken' if duty == 'none' else duty.replace('_', ' ')}"
        if duty
        else ""
    )


def agreed_word(members: Sequence[Row], column: str) -> str:
    """The word, or else its kind without the side, that holds for AGREED of the
    members; "" where there is none."""
    words = [word(row, column) for row in members]
    for choice in (words, [split_side(text)[0] for text in words]):
        text, count = min(Counter(choice).items(), key=lambda item: (-item[1], item[0]))
        if text and count >= AGREED * len(members):
            return text
    return ""
