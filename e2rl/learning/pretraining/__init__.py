"""Training by imitation: the prior, the driver bits, and the start of an actor."""
