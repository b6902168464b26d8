"""The curriculum: which scenes are attacked, how strongly, and how often episodes meet an adversary."""
