"""Verdicts, metrics and statistics of rollouts. The files imported here declare the
package's own metrics."""

from e2rl.metrics import (  # noqa: F401
    contact,
    errored,
    evasion,
    failure_features,
    failure_modes,
    margin,
    off_road,
    proximity,
    realism,
    score,
    verdicts,
)
