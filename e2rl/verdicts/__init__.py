"""Driver models that decide whether a conflict is preventable (docs/verdicts.md). Needs the scene's time step only."""
