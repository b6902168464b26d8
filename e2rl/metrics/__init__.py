"""How we tell: safety, realism and statistics as pure functions."""
