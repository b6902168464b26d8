"""The fuzzer: `python -m tools.fuzz`."""

LIMIT = 10.0  # s of the processor for one input
READERS = (
    *("pickle_bytes", "pickle_programs", "descriptions", "archives", "indexes", "commonroad", "argoverse2"),
    *("scene_caches", "rollouts", "run_files", "kept_parts", "checkpoints", "weights", "configurations"),
    *("planner_replies", "reasoner_answers"),
)
