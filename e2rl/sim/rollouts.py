"""What a rollout is: `Rollouts`, a batch as tensors; `Rollout`, one as its file holds it; `Failure`, one with its row.

A file is an npz of format e2rl-rollout/1, readable without pickle (docs/method.md, section 11).
"""

import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorClass, TensorDictBase
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from e2rl.run.errors import InputError
from e2rl.run.files import read_arrays, write_atomically
from e2rl.scenes.recording import AGENT_TYPES, DT, VEHICLE
from e2rl.scenes.scene import SceneSet

FORMAT = "e2rl-rollout/1"
ROLLOUTS = "rollouts"  # folder of a run with a file per rollout
MAP = ("lane_points", "lane_index", "lane_width", "drivable_points", "drivable_index")
MOST = 1e6  # intensity
FARTHEST, FASTEST, LONGEST, TURNED = 1e5, 150.0, 100.0, 1e3  # m, m/s, m and rad of an agent


def array(kinds: str, shape: str, low: float | None = None, high: float | None = None, **options: Any) -> Any:
    """A field of a rollout file.

    Args:
        kinds: numpy's kinds of elements that it may have: U text, b bool, i and u whole numbers, f floats.
        shape: per axis a size, or a letter for a size that is the same wherever the letter stands; "": one value.
        low, high: bounds of its values. They are lowered by the number of agents where `high` is below 0.
    """
    return field(metadata={"kinds": kinds, "shape": shape, "low": low, "high": high}, **options)


@dataclass(kw_only=True)
class Road:
    """A map without padding: lane l is lane_points[lane_offsets[l]:lane_offsets[l + 1]], drivable polygons alike."""

    lane_points: np.ndarray = array("f", "M2")
    lane_offsets: np.ndarray = array("iu", "L")
    lane_width: np.ndarray = array("f", "W")
    drivable_points: np.ndarray = array("f", "D2")
    drivable_offsets: np.ndarray = array("iu", "Q")

    def lanes(self) -> list[np.ndarray]:
        """Centreline [P, 2] m of each lane."""
        return [part for part in np.split(self.lane_points, self.lane_offsets[1:-1]) if len(part)]

    def polygons(self) -> list[np.ndarray]:
        """Ring [P, 2] m of each drivable polygon."""
        return [part for part in np.split(self.drivable_points, self.drivable_offsets[1:-1]) if len(part)]


@dataclass(kw_only=True)
class Rollout(Road):
    """One rollout as numpy arrays without padding: the content of its file.

    Optional are `ran_light` [N], the step
    at which each vehicle last crossed a stop line at red; `evasion` and `driver` [T+1, 4], the ego as the search for
    evasions and as the competent driver of the verdict drive it; `plans` [R, P, K, 2] m and `targets` [R, P] of the
    agents `planners` [P] at each of R replans.
    """

    scene_id: str = array("U", "")
    location: str = array("U", "")
    dataset: str = array("U", "")
    split: str = array("U", "")
    method: str = array("U", "")
    ego_policy: str = array("U", "")
    seed: int = array("iu", "", 0, np.inf)
    eta: float = array("iuf", "", 0, MOST)
    dt: float = array("iuf", "", 1e-3, 1, default=DT)
    ego: int = array("iu", "", 0, -1, default=0)
    states: np.ndarray = array("f", "TN4")
    valid: np.ndarray = array("b", "TN")
    size: np.ndarray = array("f", "N2")
    agent_type: np.ndarray = array("U", "N")
    simulated: np.ndarray = array("b", "N")
    adversaries: np.ndarray = array("b", "N")
    logged: np.ndarray = array("f", "TN4")
    logged_valid: np.ndarray = array("b", "TN")
    ran_light: np.ndarray | None = array("iu", "N", default=None)
    evasion: np.ndarray | None = array("f", "T4", default=None)
    driver: np.ndarray | None = array("f", "T4", default=None)
    planners: np.ndarray | None = array("iu", "P", 0, -1, default=None)
    plans: np.ndarray | None = array("f", "KPH2", default=None)
    targets: np.ndarray | None = array("iu", "KP", -1, -1, default=None)

    @property
    def name(self) -> str:
        """Name of its file."""
        return rollout_name(vars(self))

    @classmethod
    def read(cls, path: Path) -> "Rollout":
        """The rollout of a file. Raises InputError, naming the file, where it is none."""
        path = Path(path)
        try:
            data = read_arrays(path)
        except ValueError as error:
            raise InputError(f"{path}: no readable rollout ({error}); run evaluate.py again to rewrite it") from error
        known = fields(cls)
        missing = [each.name for each in known if each.default is not None and each.name not in data]
        if missing or str(data.get("format")) != FORMAT:
            raise InputError(
                f"{path}: not of format {FORMAT} (missing: {', '.join(missing) or 'nothing'}; format: "
                f"{data.get('format')}); give a folder that evaluate.py wrote"
            )
        if wrong := _misfit(data, known) or _odd_agents(data) or _odd_map(data):
            raise InputError(f"{path}: damaged: {wrong}; run evaluate.py again to rewrite it")
        found = {each.name: data[each.name] for each in known if each.name in data}
        return cls(**{name: value if value.shape else value.item() for name, value in found.items()})

    def write(self, folder: Path) -> Path:
        """Write its file into a folder, whole or not at all; returns its path."""
        known = {name: np.asarray(value) for name, value in vars(self).items() if value is not None}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, format=np.array(FORMAT), **known)
        path = Path(folder) / self.name
        write_atomically(path, buffer.getvalue())
        return path


@dataclass(frozen=True)
class Failure:
    """A rollout with its row of rollouts.csv: what happened, and what the verdicts say."""

    rollout: Rollout
    row: Mapping[str, Any]

    @classmethod
    def read(cls, run: Path, row: Mapping[str, Any]) -> "Failure":
        """The failure of a row of a run's table, with the rollout from its file."""
        return cls(Rollout.read(Path(run) / ROLLOUTS / rollout_name(row)), row)

    @property
    def contact(self) -> int | None:
        """Step of the ego's first contact; None: there is none."""
        step = self.row["contact_step"]
        return int(step) if step == step else None

    @property
    def partner(self) -> int:
        """Row of the agent that the ego hits; -1: nobody."""
        return int(self.row["partner"])


def rollout_name(row: Mapping[str, Any]) -> str:
    """<method>__<ego>__<eta>__<scene_id>__<seed>.npz of a row or rollout; '-' for what no file name may hold."""
    parts = (row["method"], row["ego_policy"], f"{float(row['eta']):g}", row["scene_id"], row["seed"])
    return "__".join(re.sub(r"[^A-Za-z0-9._+-]", "-", str(part)) for part in parts) + ".npz"


class Rollouts(TensorClass["shadow"]):  # `size` and `split` are fields, not methods
    """B rollouts of N agents, the ego first, over T steps of DT; step 0 is the start. Everything lies on the CPU.

    Indexing and `torch.cat` work as for tensors: `rollouts[mask]`, `rollouts[3]` (without the leading B). What is None
    is not known. Vehicles have the rows 0 .. V-1.
    """

    states: Tensor  # [B, T+1, N, 4]: x, y [m], heading [rad], speed [m/s]
    valid: Tensor  # [B, T+1, N] bool: there
    size: Tensor  # [B, N, 2] m: length, width
    agent_type: Tensor  # [B, N] int64: index into AGENT_TYPES
    simulated: Tensor  # [B, N] bool: driven by the simulator
    adversaries: Tensor  # [B, N] bool: under adversarial control at any time
    logged: Tensor  # as states: the recording of the same period
    logged_valid: Tensor  # as valid
    lane_points: Tensor  # [B, M, 2] m
    lane_index: Tensor  # [B, M] int64: the lane of each point, -1 padding
    lane_width: Tensor  # [B, L] m
    drivable_points: Tensor  # [B, D, 2] m
    drivable_index: Tensor  # [B, D] int64: the polygon of each point, -1 padding
    seed: Tensor  # [B] int64
    eta: Tensor  # [B] float64: intensity
    scene_id: list[str]
    location: list[str]  # "": unknown
    dataset: list[str] | None = None  # the source, of rollouts of a run
    split: list[str] | None = None
    method: list[str] | None = None
    ego_policy: list[str] | None = None
    parked: Tensor | None = None  # [B, N] bool
    ran_light: Tensor | None = None  # [B, N] int64: step of the last stop line crossed at red, -1 never
    routes: Tensor | None = None  # [B, V] int64: route candidates followed, -1 none
    contact: Tensor | None = None  # [B] bool: the ego touched a vehicle
    transport_adversary: Tensor | None = None  # [B]: path KL of the control
    transport_others: Tensor | None = None  # [B]
    transport_anchor: Tensor | None = None  # [B]: anchor jump
    seconds: Tensor | None = None  # [B]: wall time
    nfe: Tensor | None = None  # [B]: evaluations of the prior's network
    plans: Tensor | None = None  # [B, R, V, K, 2] m: at each of R replans
    targets: Tensor | None = None  # [B, R, V] int64: whom each vehicle aims at, 0 the ego, -1 nobody
    evasion: Tensor | None = None  # [B, T+1, 4]: of the ego (metrics.evasion), NaN: none was found
    driver: Tensor | None = None  # [B, T+1, 4]: the competent driver in the ego's place, NaN: no collision

    @classmethod
    def in_scenes(
        cls,
        scenes: SceneSet,
        index: Tensor,
        states: Tensor,
        valid: Tensor,
        scene: TensorDictBase | None = None,
        replays_ego: bool = False,
        **known: Any,
    ) -> "Rollouts":
        """Rollouts of scenes, with what these tell: sizes, types, recording, map and names.

        Args:
            scenes: the scenes.
            index: [B] int64, which of them.
            states, valid: the motion.
            scene: the batch of these scenes, where it is at hand.
            replays_ego: the ego is its recording, not simulated.
            known: further fields, among them adversaries, seed and eta.
        """
        scene = scenes.batch(index) if scene is None else scene
        start, kind = scene["valid"], scene["agent_type"]
        slots = torch.arange(start.shape[1], device=start.device) < scene["route_log"].shape[1]
        simulated = start & slots & (kind == VEHICLE)
        simulated[:, 0] &= not replays_ego
        names = {"scene_id": scenes.scene_id, "location": scenes.location}
        return cls(
            states=states,
            valid=valid,
            simulated=simulated,
            logged_valid=scene["logged_valid"] & start[:, None],
            **{name: scene[name] for name in ("size", "agent_type", "parked", "logged", *MAP)},
            **{name: [values[i] for i in index.tolist()] for name, values in names.items()},
            **known,
            batch_size=[len(index)],
        ).cpu()

    @classmethod
    def of(cls, rollouts: Sequence[Rollout]) -> "Rollouts":
        """Rollouts, padded to the longest; without plans, targets, evasion and driver, which drawings alone need."""

        def pad(name: str, fill: float = 0) -> Tensor:
            arrays = [torch.as_tensor(getattr(rollout, name)) for rollout in rollouts]
            shape = [max(sizes) for sizes in zip(*(each.shape for each in arrays), strict=True)]
            result = torch.full((len(arrays), *shape), fill, dtype=arrays[0].dtype)
            for row, each in zip(result, arrays, strict=True):
                row[tuple(slice(length) for length in each.shape)] = each
            return result

        padded = ("states", "valid", "size", "simulated", "adversaries", "logged", "logged_valid")
        padded += ("lane_points", "lane_width", "drivable_points")
        codes = [[AGENT_TYPES.index(kind) for kind in rollout.agent_type.tolist()] for rollout in rollouts]
        lights = all(rollout.ran_light is not None for rollout in rollouts)
        texts = ("scene_id", "location", "dataset", "split", "method", "ego_policy")
        return cls(
            **{name: pad(name) for name in padded},
            agent_type=pad_sequence([torch.tensor(each) for each in codes], batch_first=True),
            **{
                f"{name}_index": pad_sequence(
                    [torch.from_numpy(line_numbers(getattr(rollout, f"{name}_offsets"))) for rollout in rollouts],
                    batch_first=True,
                    padding_value=-1,
                )
                for name in ("lane", "drivable")
            },
            ran_light=pad("ran_light", -1) if lights else None,
            seed=torch.tensor([rollout.seed for rollout in rollouts]),
            eta=torch.tensor([rollout.eta for rollout in rollouts], dtype=torch.float64),
            **{name: [getattr(rollout, name) for rollout in rollouts] for name in texts},
            batch_size=[len(rollouts)],
        )

    @classmethod
    def from_npz(cls, paths: Path | Iterable[Path]) -> "Rollouts":
        """The rollouts of one or several files, padded. Raises InputError, naming the file, where one is damaged."""
        return cls.of([Rollout.read(path) for path in ([paths] if isinstance(paths, str | Path) else paths)])

    def to_npz(self, folder: Path) -> list[Path]:
        """Write a file for each of B rollouts into a folder; returns their paths."""
        return [self.rollout(index).write(folder) for index in range(len(self))]

    def rollout(self, index: int) -> Rollout:
        """One of B rollouts as numpy arrays. Plans are those of the ego and of the adversaries."""
        row = self[index]
        texts = ("scene_id", "location", "dataset", "split", "method", "ego_policy")
        plans = {}
        if row.plans is not None:
            planners = row.adversaries[: row.plans.shape[1]].bool().clone()
            planners[0] = True
            plans["planners"] = planners.nonzero()[:, 0].numpy()
            plans |= {"plans": row.plans[:, planners].float().numpy(), "targets": row.targets[:, planners].numpy()}
        return Rollout(
            **{name: str(getattr(row, name) or "") for name in texts},
            seed=int(row.seed),
            eta=float(row.eta),
            agent_type=np.array(AGENT_TYPES)[row.agent_type.numpy()],
            **{name: getattr(row, name).float().numpy() for name in ("states", "size", "logged")},
            **{name: getattr(row, name).numpy() for name in ("valid", "simulated", "adversaries", "logged_valid")},
            **vars(road_of(row)),
            ran_light=None if row.ran_light is None else row.ran_light.numpy(),
            evasion=_known_track(row.evasion),
            driver=_known_track(row.driver),
            **plans,
        )


def road_of(scene: Rollouts | TensorDictBase) -> Road:
    """The map of one scene or rollout, without its padding."""
    found = {name: scene.get(name) for name in MAP}
    lanes, lane_offsets, whole = polylines(found["lane_points"], found["lane_index"], minimum=2)
    rings, ring_offsets, _ = polylines(found["drivable_points"], found["drivable_index"], minimum=3)
    return Road(
        lane_points=lanes,
        lane_offsets=lane_offsets,
        lane_width=found["lane_width"].float().numpy()[whole],
        drivable_points=rings,
        drivable_offsets=ring_offsets,
    )


def polylines(points: Tensor, index: Tensor, minimum: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points [M, 2] float32, offsets [L + 1] int64, line numbers [L]) of padded points [P, 2] with index [P].

    Lines of fewer than `minimum` points are left out.
    """
    line = index.numpy()
    counts = np.bincount(line[line >= 0], minlength=1)
    whole = np.flatnonzero(counts >= minimum)
    chosen = np.isin(line, whole)
    order = np.argsort(line[chosen], kind="stable")
    return (
        points.float().numpy()[chosen][order],
        np.concatenate([[0], np.cumsum(counts[whole])]).astype(np.int64),
        whole,
    )


def line_numbers(offsets: np.ndarray) -> np.ndarray:
    """The line number of each point [M] of lines that start and end at offsets [L + 1]."""
    return np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))


def _known_track(track: Tensor | None) -> np.ndarray | None:
    """A track [T+1, 4] as an array; None where it is not known or has NaN."""
    return None if track is None or bool(track.isnan().any()) else track.float().numpy()


def _misfit(data: Mapping[str, np.ndarray], known: Iterable[Field]) -> str | None:
    """Which array of a file has another type, shape or range than its field; None: none."""
    sizes: dict[str, int] = {}
    for each in known:
        if each.name not in data:
            continue
        value, (kinds, shape, low, high) = data[each.name], each.metadata.values()
        if not shape and (value.shape != () or value.dtype.kind not in kinds):
            return f"{each.name} is no single {'text' if kinds == 'U' else 'number'}"
        wrong = value.ndim != len(shape) or value.dtype.kind not in kinds
        if wrong or any(
            sizes.setdefault(letter, int(letter) if letter.isdigit() else size) != size
            for letter, size in zip(shape, value.shape, strict=True)
        ):
            return f"{each.name} has shape {value.shape} and type {value.dtype}"
    if min(sizes["T"], sizes["N"]) < 1 or sizes["L"] != sizes["W"] + 1:
        return "it holds no agent, or as many lanes as borders between them"
    if len(data.keys() & {"planners", "plans", "targets"}) not in (0, 3):
        return "of planners, plans, targets some are missing"
    for each in known:
        low, high = each.metadata["low"], each.metadata["high"]
        if low is not None and each.name in data:
            most = high + sizes["N"] if high < 0 else high
            if not ((data[each.name] >= low) & (data[each.name] <= most)).all():  # NaN is not, either
                return f"{each.name} is out of range"
    return None


def _odd_agents(data: Mapping[str, np.ndarray]) -> str | None:
    """Which agents are of no type, of no size, or where no agent can be."""
    if not set(data["agent_type"].tolist()) <= set(AGENT_TYPES):
        return "agent_type names an unknown type"
    size = data["size"][data["valid"].any(0)]
    if not ((size > 0) & (size <= LONGEST)).all():
        return f"an agent's size is not between 0 and {LONGEST:g} m"
    for name, known in (("states", "valid"), ("logged", "logged_valid")):
        states = data[name][data[known]]
        if not np.isfinite(states).all():
            return "a valid state is NaN or infinite"
        if (np.abs(states) > [FARTHEST, FARTHEST, TURNED, FASTEST]).any():
            return f"a valid state of {name} is beyond {FARTHEST:g} m, {TURNED:g} rad or {FASTEST:g} m/s"
    return None


def _odd_map(data: Mapping[str, np.ndarray]) -> str | None:
    """Which lines of the map are not divided, or are NaN or infinite."""
    for name in ("lane", "drivable"):
        offsets = data[f"{name}_offsets"].astype(np.int64)
        ends = (offsets[:1].tolist(), offsets[-1:].tolist())
        if ends != ([0], [len(data[f"{name}_points"])]) or (np.diff(offsets) < 0).any():
            return f"{name}_offsets do not divide {name}_points"
        if not np.isfinite(data[f"{name}_points"]).all():
            return f"{name}_points are NaN or infinite"
    return None if np.isfinite(data["lane_width"]).all() else "lane_width is NaN or infinite"
