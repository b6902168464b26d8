"""Drives rollouts: every method of traffic against an ego, batch by batch, and scores
them."""
