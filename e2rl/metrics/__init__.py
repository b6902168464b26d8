"""Verdicts, metrics and statistics of rollouts. The files imported here declare the
package's own metrics, whose columns follow each other in this order."""

# ruff: noqa: I001, F401
from e2rl.metrics import realism
from e2rl.metrics import contact
from e2rl.metrics import traffic_contact
from e2rl.metrics import errored
from e2rl.metrics import evasion
from e2rl.metrics import verdicts
from e2rl.metrics import failure_features
from e2rl.metrics import failure_modes
from e2rl.metrics import margin
from e2rl.metrics import off_road
from e2rl.metrics import proximity
from e2rl.metrics import score
