"""The catalogue of metrics: what each is, how it is averaged, where it is printed, and what computes it.

A metric is added by one call of `register`, here or in any module that is imported before rollouts are scored.
"""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from e2rl.metrics.contact import KINDS, contact_columns, traffic_contact_columns
from e2rl.metrics.failure_features import APPROACHES, MANOEUVRES, failure_columns
from e2rl.metrics.meta_metric import FEATURES
from e2rl.metrics.off_road import off_road_columns
from e2rl.metrics.proximity import motion_columns, standing_columns
from e2rl.metrics.realism import W1
from e2rl.metrics.verdicts import DUTIES, verdict_columns

Compute = Callable[[dict[str, Tensor]], Tensor | dict[str, Tensor]]


@dataclass(frozen=True)
class Metric:
    """What a metric is, how it is averaged over rollouts, and how it is printed.

    It is the mean of its column over the rollouts that know it (that are not NaN), unless other fields say otherwise.
    """

    name: str
    about: str
    unit: str = ""
    share: bool = False  # in [0, 1], printed in per cent
    decimals: int | None = None  # printed; None: three significant digits
    column: str = ""  # of the rows, where it differs from the name
    weight: str = ""  # column that weights the mean
    per: str = ""  # column by whose sum the sum of its own column is divided, instead of the mean
    median: bool = False  # instead of the mean
    places: int = 0  # of a column of labels: expected number of labels at so many places, instead of the mean
    samples: str = ""  # of a metric that `metrics.realism` computes from pooled samples: those that it needs
    per_collision: bool = False  # known for collisions only: paired differences compare each group's own collisions
    tables: tuple[str, ...] = ()  # closed-loop tables that `register` appends it to; a new name makes a new table

    @property
    def source(self) -> str:
        """The rows' column that holds it."""
        return self.column or self.name


MAIN = (
    Metric("cfr", "ego hits any vehicle", share=True),
    Metric("cfr_counted", "a failure that counts: preventable, or the ego's fault", share=True),
    Metric("cfr_preventable", "a failure that a competent driver prevents", share=True),
    Metric("cfr_adv", "ego hits an adversary", share=True),
    Metric("cfr_vru", "ego hits a pedestrian or cyclist", share=True),
    Metric("cfr_bg", "other simulated vehicles hit each other", share=True),
    Metric("avoidable", "collisions that some ego actions avoid, found by search", share=True, per_collision=True),
    Metric("front", "first contact at the ego's front", share=True),
    Metric("side", "first contact at the ego's side", share=True),
    Metric("rear", "first contact at the ego's rear", share=True),
    Metric("rir", "rear impacts per collision", share=True, per_collision=True),
    Metric("counted", "collisions that count", share=True, per_collision=True),
    Metric("at_fault", "ego's fault, per collision", share=True, per_collision=True),
    Metric("preventable", "prevented by UN R157's careful and competent driver", share=True, per_collision=True),
    Metric("relvel", "speed difference before contact", unit="m/s", per_collision=True),
    Metric("contact_time", "median time of the first contact", unit="s", median=True, per_collision=True),
    Metric("min_dtc", "smallest gap to another agent", unit="m"),
    Metric("ttc_c", "time-to-collision cost, adversaries"),
    Metric("macc", "ego's mean |acceleration|", unit="m/s²"),
    Metric("progress", "distance that the ego drives", unit="m"),
    Metric("aor_step", "off the road, of vehicle-steps", share=True, weight="aor_vehicle_steps"),
    Metric("aor_any", "off the road, of rollouts", share=True),
    Metric("real", "realism, 1 - mean capped W1", decimals=3, samples="a_lon"),
    Metric("real_adv", "realism of the adversaries alone", decimals=3, samples="a_lon_adversary"),
    Metric("real_norm", "realism, W1 over the log's range", decimals=3, samples="a_lon"),
    Metric("transport", "path KL of the control"),
    Metric("seconds_per_rollout", "wall time", unit="s", column="seconds"),
    Metric("passes", "passes of the prior's network per rollout, a gradient's twice"),
    Metric("ego_off_road", "ego leaves the road", share=True),
)
PLACES = 10  # at which `mode_coverage` looks: failures at fewer places give none
COVERAGE = f"failure modes expected of collisions at {PLACES} places"
EXTRA = (
    Metric("mode_coverage", COVERAGE, decimals=1, column="mode", places=PLACES, per_collision=True),
    Metric(
        "mode_coverage_counted",
        "the same, of collisions that count",
        decimals=1,
        column="mode",
        weight="counted",
        places=PLACES,
        per_collision=True,
    ),
    Metric("preventable_fsm", "prevented by the fuzzy safety model", share=True, per_collision=True),
    Metric("preventable_rss", "prevented by RSS", share=True, per_collision=True),
    Metric("preventable_regulation", "prevented at UN R157's limit", share=True, per_collision=True),
    Metric("preventable_chain", "prevented if a follower brakes, too", share=True, per_collision=True),
    Metric("avoidable_1s", "the same, acting only 1 s before contact", share=True, per_collision=True),
    Metric("evasion_accel", "peak acceleration of the mildest evasion found", unit="m/s²", per_collision=True),
    Metric("front_any", "ego's front in contact at first contact", share=True),
    Metric("side_any", "ego's side in contact at first contact", share=True),
    Metric("rear_any", "ego's rear in contact at first contact", share=True),
    Metric("bg_pairs", "pairs of other vehicles that hit each other"),
    Metric("touched", "moving vehicles that touch another simulated one", share=True, weight="moving_vehicles"),
    Metric("parked_moved", "parked vehicles that move > 2 m", share=True, weight="parked_vehicles"),
    Metric("starts", "standing vehicles that start, over the log's", share=True, column="starters", per="starters_log"),
    Metric("ttc_c_all", "time-to-collision cost, all agents"),
    Metric("transport_adversary", "path KL of the control, adversaries"),
    Metric("transport_others", "path KL of the control, other vehicles"),
    Metric("transport_anchor", "anchor jump"),
    Metric("w1_a_lon", "W1 of longitudinal acceleration", unit="m/s²", samples="a_lon"),
    Metric("w1_a_lat", "W1 of lateral acceleration", unit="m/s²", samples="a_lon"),
    Metric("w1_jerk", "W1 of |jerk|", unit="m/s³", samples="a_lon"),
    Metric("route_completion", "share of the recorded ego's way driven until contact", share=True),
    Metric("failures_per_km", "`cfr`, of all that the ego drives", unit="1/km", column="cfr", per="driven_km"),
    Metric("counted_per_km", "the same of `cfr_counted`", unit="1/km", column="cfr_counted", per="driven_km"),
)
METRICS = {metric.name: metric for metric in (*MAIN, *EXTRA)}  # of rollouts, in the order of rollouts.csv
TABLES = {
    "main": [metric.name for metric in MAIN],
    "traffic": [  # whether background traffic is realistic
        *("cfr", "cfr_bg", "touched", "aor_step", "aor_any"),
        *("real", "real_norm", *W1, "parked_moved", "starts", "seconds_per_rollout"),
    ],
    "adversaries": [  # what tells adversaries apart: the failures they find, and what these cost
        *(
            "cfr",
            "cfr_counted",
            "cfr_preventable",
            "counted",
            "at_fault",
            "preventable",
            "cfr_adv",
            "mode_coverage",
            "mode_coverage_counted",
        ),
        *("avoidable", "contact_time", "front", "side", "rear", "rir", "relvel"),
        *("ttc_c", "cfr_bg", "aor_step", "real", "real_adv", "transport"),
    ],
    "methods": [  # table 1: what each method finds, how real it is, what it costs
        *("cfr", "cfr_counted", "cfr_preventable", "cfr_adv", "at_fault", "preventable", "relvel", "rir", "min_dtc"),
        *("ttc_c", "cfr_bg", "aor_step", "aor_any", "real", "real_adv", "seconds_per_rollout", "passes"),
    ],
    "egos": [  # table 4: how each ego fails, where it is hit, and whose failure it is
        *("cfr", "cfr_counted", "cfr_preventable", "at_fault", "preventable", "front", "side", "rear"),
        *("front_any", "side_any", "rear_any", "relvel", "contact_time", "progress", "macc", "ego_off_road"),
    ],
    "public": [  # what papers on adversarial training report, and whose failures these are
        *("cfr", "route_completion", "ego_off_road", "cfr_counted", "cfr_preventable", "at_fault", "cfr_vru"),
        *("progress", "macc", "aor_step", "real_adv"),
    ],
}  # closed-loop tables (`metrics=...` of evaluate.py) and the metrics of each, in order
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
    Metric("real_split_half", "`real` of one half of the logs against the other", decimals=3),
)
OPEN_LOOP_STAGE, META_STAGE = "open loop", "meta-metric"
STAGES = {OPEN_LOOP_STAGE: OPEN_LOOP, META_STAGE: META}  # parts of a run with metrics of their own
IDENTITY = ("scene_id", "location", "seed", "eta")  # of a row, before its metrics
EVENT = (
    *("contact_type", "partner", "contact_step", "aor_vehicle_steps", "moving_vehicles", "parked_vehicles"),
    *("starters_log", "aor_left_out", "start_overlap_ego", "start_overlap_bg", "evasion_tried", "evasion_seconds"),
    *("duty", "approach", "ego_manoeuvre", "partner_manoeuvre", "ego_speed", "partner_speed"),
)  # of a row, after its metrics
WORDS = {
    "contact_type": KINDS,
    "duty": DUTIES,
    "approach": APPROACHES,
    "ego_manoeuvre": MANOEUVRES,
    "partner_manoeuvre": MANOEUVRES,
}  # columns of a row that hold one of these words, or "" where a function computes the index -1


def transport_columns(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """The control's path KL of adversaries and others, their sum `transport`, and the anchor's jump, where known."""
    names = ("transport_adversary", "transport_others", "transport_anchor")
    columns = {name: batch[name].to(batch["states"].dtype) for name in names if name in batch}
    return columns | ({"transport": columns[names[0]] + columns[names[1]]} if columns else {})


def pass_columns(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """The passes of the prior's network, where known."""
    return {"passes": batch["passes"].to(batch["states"].dtype)} if "passes" in batch else {}


COMPUTE: dict[str, Compute] = {
    "contact": contact_columns,
    "traffic_contact": traffic_contact_columns,
    "failure": failure_columns,
    "verdicts": verdict_columns,
    "motion": motion_columns,
    "off_road": off_road_columns,
    "standing": standing_columns,
    "transport": transport_columns,
    "passes": pass_columns,
}  # functions of a batch of rollouts: a dict of columns, or the column of the metric with the function's key


def register(metric: Metric, compute: Compute | None = None) -> None:
    """Add a metric of rollouts to rollouts.csv, metrics.json and its tables.

    compute(batch) returns the metric's column [B], NaN where it is unknown, or a dict of columns: this one, and those
    that `weight` or `per` name. `score_rollouts` calls it on the CPU for at most 32 rollouts at once. The batch holds
    the tensors of the rollout dict (positions in float64, 0 where invalid), `traffic` [B, N] bool, the simulated
    vehicles other than the ego, and the fields of `contact.first_contact`, such as `hit` and `stop` [B]. Without
    compute, the metric is read from a column that exists already or is added to the rows later.

    Raises ValueError for a name or column that is taken.
    """
    if metric.name in {*METRICS, *COMPUTE} or (compute is not None and metric.source in row_columns()):
        raise ValueError(f"metric {metric.name}: name or column is taken; choose another, or unregister it first")
    METRICS[metric.name] = metric
    if compute is not None:
        COMPUTE[metric.name] = compute
    for table in metric.tables:
        TABLES.setdefault(table, []).append(metric.name)


def unregister(name: str) -> None:
    """Take a registered metric out of the catalogue again."""
    metric = METRICS.pop(name)
    COMPUTE.pop(name, None)
    for table in metric.tables:
        TABLES[table].remove(name)


def table_metrics(table: str) -> tuple[Metric, ...]:
    """The metrics of a closed-loop table, in its order."""
    return tuple(METRICS[name] for name in TABLES[table])


def row_columns() -> tuple[str, ...]:
    """Columns of a row: its identity, its metrics, then events and what metrics are weighted or divided by."""
    metrics = METRICS.values()
    weights = [name for metric in metrics for name in (metric.weight, metric.per) if name]
    return tuple(dict.fromkeys((*IDENTITY, *(metric.source for metric in metrics), *EVENT, *weights)))
