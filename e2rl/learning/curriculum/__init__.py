"""The curriculum: priorities of scenes, adversarial intensity, and share of adversarial episodes."""
