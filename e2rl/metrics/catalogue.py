"""The metrics, in the order of every table (design.md section 5), and how each is averaged over rollouts."""

from dataclasses import dataclass

from e2rl.metrics.meta_metric import FEATURES


@dataclass(frozen=True)
class Metric:
    """One metric: `weight` names the rows' column that weighs rollouts, a share in [0, 1] is printed in per cent."""

    name: str
    about: str
    unit: str = ""
    share: bool = False
    column: str = ""  # of the rows, where it differs from the name; "" is the name
    weight: str = ""
    per: str = ""  # rows' column that the metric is a quotient by: sum over sum, not a mean of quotients
    pooled: bool = False  # computed from the samples of all rollouts together, not from the rows
    median: bool = False  # over the rollouts that know it, instead of the mean

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
    Metric("contact_time", "median time of the first contact", unit="s", median=True),
    Metric("min_dtc", "smallest gap to another agent", unit="m"),
    Metric("ttc_c", "time-to-collision cost, adversaries"),
    Metric("macc", "ego's mean |acceleration|", unit="m/s²"),
    Metric("progress", "ego's way", unit="m"),
    Metric("aor_step", "off the road, of vehicle-steps", share=True, weight="aor_vehicle_steps"),
    Metric("aor_any", "off the road, of rollouts", share=True),
    Metric("real", "realism, 1 - mean capped W1", pooled=True),
    Metric("real_adv", "realism of the adversaries alone", pooled=True),
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
    Metric("touched", "moving vehicles that touch another simulated one", share=True, weight="moving_vehicles"),
    Metric("parked_moved", "parked vehicles that move > 2 m", share=True, weight="parked_vehicles"),
    Metric(
        "starts",
        "standing vehicles that start, per one that starts in the log",
        share=True,
        column="starters",
        per="starters_log",
    ),
    Metric("ttc_c_all", "time-to-collision cost, all agents"),
    Metric("transport_adversary", "path KL of the control, adversaries"),
    Metric("transport_others", "path KL of the control, other vehicles"),
    Metric("transport_anchor", "anchor jump"),
    Metric("w1_a_lon", "W1 of longitudinal acceleration", unit="m/s²", pooled=True),
    Metric("w1_a_lat", "W1 of lateral acceleration", unit="m/s²", pooled=True),
    Metric("w1_jerk", "W1 of |jerk|", unit="m/s³", pooled=True),
)
METRICS = {metric.name: metric for metric in MAIN + EXTRA}
TRAFFIC = tuple(
    METRICS[name]
    for name in (
        "cfr",
        "cfr_bg",
        "touched",
        "aor_step",
        "aor_any",
        "real",
        "real_norm",
        "w1_a_lon",
        "w1_a_lat",
        "w1_jerk",
        "parked_moved",
        "starts",
        "seconds_per_rollout",
    )
)  # what says whether background traffic is realistic
ADVERSARIES = tuple(
    METRICS[name]
    for name in (
        "cfr",
        "cfr_adv",
        "avoidable",
        "contact_time",
        "front",
        "side",
        "rear",
        "rir",
        "relvel",
        "ttc_c",
        "cfr_bg",
        "aor_step",
        "real",
        "real_adv",
        "transport",
    )
)  # what tells adversaries apart: failures found, and what they cost
CLOSED_LOOP = {"main": MAIN, "traffic": TRAFFIC, "adversaries": ADVERSARIES}
OPEN_LOOP = tuple(
    Metric(f"{name}_{horizon}", about.format(horizon), unit=unit)
    for horizon in (3, 5)
    for name, about, unit in (
        ("min_ade", "mean displacement over {} s, each vehicle's best sample", "m"),
        ("mean_ade", "the same, mean over samples", "m"),
        ("joint_ade", "the same, the scene's best sample for all its vehicles", "m"),
        ("cv_ade", "constant velocity's displacement over {} s, same vehicles", "m"),
        ("min_ade_ratio", "min_ade over cv_ade at {} s", ""),
        ("mean_ade_ratio", "mean_ade over cv_ade at {} s", ""),
    )
)
META = (
    Metric("meta_metric", "realism meta-metric, weighted likelihood of the log"),
    *(
        Metric(name, f"likelihood of the logged {name.replace('_', ' ')}, weight {feature.weight:g}")
        for name, feature in FEATURES.items()
    ),
    Metric("real_split_half", "`real` of one half of the logs against the other"),
)
OPEN_LOOP_STAGE, META_STAGE = "open loop", "meta-metric"
STAGES = {OPEN_LOOP_STAGE: OPEN_LOOP, META_STAGE: META}  # parts of a run with metrics of their own
IDENTITY = ("scene_id", "location", "seed", "eta")  # of a row, before its metrics
SEARCH = ("evasion_tried", "evasion_seconds")  # what the search for evasions took
EVASION = ("avoidable", "avoidable_1s", "evasion_accel", *SEARCH)  # NaN until evaluation.avoidable has searched
EVENT = (
    "contact_type",
    "partner",
    "contact_step",
    "aor_vehicle_steps",
    "moving_vehicles",
    "parked_vehicles",
    "starters_log",
    "aor_left_out",
    "start_overlap_ego",
    "start_overlap_bg",
    *SEARCH,
)  # of a row, beside the metrics
