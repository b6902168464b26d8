"""Who drives the other vehicles: one interface, the plain methods behind it, and its TorchRL transform."""
