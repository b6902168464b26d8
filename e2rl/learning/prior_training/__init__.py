"""How the prior is trained: windows of logs, loss, optimisation, one process or several."""
