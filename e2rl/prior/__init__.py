"""The prior: a frozen reverse-time SDE over joint traffic futures."""
