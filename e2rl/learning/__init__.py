"""How it improves: updates, planner tuning, curriculum, the evolution round."""
