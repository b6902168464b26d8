"""`plugins: [e2rl.metrics.nuplan]`: every row has nuPlan's scores, and `metrics=nuplan`
is their table."""

from e2rl.metrics.catalogue import columns
from e2rl.metrics.nuplan_scores import SCORES, nuplan_columns

columns(*SCORES)(nuplan_columns)
