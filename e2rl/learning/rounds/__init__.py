"""Rounds of Algorithm 1: attacks on the ego, and learning from them."""
