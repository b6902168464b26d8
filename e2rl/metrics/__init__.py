"""Verdicts, metrics and statistics of rollouts. The files imported here declare the
package's own metrics."""

from e2rl.metrics import (  # noqa: F401
    contact,
    displacement,
    errored,
    evasion,
    failure_features,
    failure_modes,
    margin,
    meta_metric,
    off_road,
    proximity,
    realism,
    score,
    verdicts,
)
