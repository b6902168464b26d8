"""Training of the prior: windows of logs, loss, optimisation."""
