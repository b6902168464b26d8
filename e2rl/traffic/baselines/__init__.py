"""The adversaries of other works behind the traffic interface, on the common prior
(docs/reference/deviations.md)."""
