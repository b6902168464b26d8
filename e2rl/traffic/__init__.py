"""Traffic: the interface of methods that drive the other vehicles, simple methods, and
the TorchRL transform."""
