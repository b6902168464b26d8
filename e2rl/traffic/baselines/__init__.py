"""Rivals of e2: the adversaries of other works behind the traffic interface, on the common prior (docs/rivals.md)."""
