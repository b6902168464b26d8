"""Learning: policy updates, planner tuning, curriculum, the evolution round."""
