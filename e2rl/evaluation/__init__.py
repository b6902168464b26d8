"""The closed-loop protocol and the files that a run writes."""
