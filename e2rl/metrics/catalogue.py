"""The metrics, in the order of every table (design.md section 5), and how each is averaged over rollouts."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    """One metric: `weight` names the rows' column that weighs rollouts, a share in [0, 1] is printed in per cent."""

    name: str
    about: str
    unit: str = ""
    share: bool = False
    column: str = ""  # of the rows, where it differs from the name; "" is the name
    weight: str = ""
    pooled: bool = False  # computed from the samples of all rollouts together, not from the rows

    @property
    def source(self) -> str:
        return self.column or self.name


MAIN = (
    Metric("cfr", "ego hits any vehicle", share=True),
    Metric("cfr_adv", "ego hits an adversary", share=True),
    Metric("cfr_vru", "ego hits a pedestrian or cyclist", share=True),
    Metric("cfr_bg", "other simulated vehicles hit each other", share=True),
    Metric("avoidable", "collisions that some ego actions avoid, found by search", share=True),
    Metric("front", "first contact at the ego's front", share=True),
    Metric("side", "first contact at the ego's side", share=True),
    Metric("rear", "first contact at the ego's rear", share=True),
    Metric("rir", "rear impacts per collision", share=True),
    Metric("at_fault", "ego's fault, per collision", share=True),
    Metric("relvel", "speed difference before contact", unit="m/s"),
    Metric("min_dtc", "smallest gap to another agent", unit="m"),
    Metric("ttc_c", "time-to-collision cost, adversaries"),
    Metric("macc", "ego's mean |acceleration|", unit="m/s²"),
    Metric("progress", "ego's way", unit="m"),
    Metric("aor_step", "off the road, of vehicle-steps", share=True, weight="aor_vehicle_steps"),
    Metric("aor_any", "off the road, of rollouts", share=True),
    Metric("real", "realism, 1 - mean capped W1", pooled=True),
    Metric("real_norm", "realism, W1 over the log's range", pooled=True),
    Metric("transport", "path KL of the control"),
    Metric("seconds_per_rollout", "wall time", unit="s", column="seconds"),
)
EXTRA = (
    Metric("avoidable_1s", "the same, acting only 1 s before contact", share=True),
    Metric("evasion_accel", "peak acceleration of the mildest evasion found", unit="m/s²"),
    Metric("front_any", "ego's front in contact at first contact", share=True),
    Metric("side_any", "ego's side in contact at first contact", share=True),
    Metric("rear_any", "ego's rear in contact at first contact", share=True),
    Metric("bg_pairs", "pairs of other vehicles that hit each other"),
    Metric("ttc_c_all", "time-to-collision cost, all agents"),
    Metric("transport_adversary", "path KL of the control, adversaries"),
    Metric("transport_others", "path KL of the control, other vehicles"),
    Metric("transport_anchor", "anchor jump"),
    Metric("w1_a_lon", "W1 of longitudinal acceleration", unit="m/s²", pooled=True),
    Metric("w1_a_lat", "W1 of lateral acceleration", unit="m/s²", pooled=True),
    Metric("w1_jerk", "W1 of |jerk|", unit="m/s³", pooled=True),
)
METRICS = {metric.name: metric for metric in MAIN + EXTRA}
IDENTITY = ("scene_id", "location", "seed", "eta")  # of a row, before its metrics
SEARCH = ("evasion_tried", "evasion_seconds")  # what the search for evasions took
EVASION = ("avoidable", "avoidable_1s", "evasion_accel", *SEARCH)  # NaN until evaluation.avoidable has searched
EVENT = (
    "contact_time",
    "contact_type",
    "partner",
    "contact_step",
    "aor_vehicle_steps",
    "aor_left_out",
    "start_overlap_ego",
    "start_overlap_bg",
    *SEARCH,
)  # of a row, beside the metrics
