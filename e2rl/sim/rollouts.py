"""What a rollout is: `Rollouts`, a batch as padded tensors; `Rollout` is one of them,
as its file holds it."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorClass, TensorDictBase
from torch import Tensor

from e2rl.scenes.recording import AGENT_TYPES, VEHICLE
from e2rl.scenes.scene import SceneSet
from e2rl.sim.rollout_file import Road, Rollout

TEXTS = ("scene_id", "location", "dataset", "split", "method", "ego_policy")
MAP = ("lane_points", "lane_index", "lane_width", "drivable_points", "drivable_index")
PADDING = dict.fromkeys(
    ("lane_index", "drivable_index", "ran_light", "routes", "targets"), -1
) | dict.fromkeys(("evasion", "driver"), torch.nan)  # where it is not 0


class Rollouts(TensorClass["shadow"]):  # type: ignore[name-defined]  # `size` and `split` are fields, not methods
    """B rollouts of N agents, the ego first, over T steps of DT; step 0 is the start.
    Everything lies on the CPU.

    Indexing and `torch.cat` work as for tensors: `rollouts[mask]`, `rollouts[3]`
    (without the leading B). What is None is not known. Vehicles have the rows 0 .. V-1.
    `torch.cat` pads maps and tracks to the largest, and does not know what one of them
    does not.
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
    ran_light: Tensor | None = (
        None  # [B, N] int64: step of the last stop line crossed at red, -1 never
    )
    speed_limit: Tensor | None = (
        None  # [B, T+1] m/s: of the ego's mission where it is, 0 unknown
    )
    routes: Tensor | None = None  # [B, V] int64: route candidates followed, -1 none
    contact: Tensor | None = None  # [B] bool: the ego touched a vehicle
    left_out: Tensor | None = (
        None  # [B] int64: vehicles that come near in the recording and are not there
    )
    transport_adversary: Tensor | None = None  # [B]: path KL of the control
    transport_others: Tensor | None = None  # [B]
    transport_anchor: Tensor | None = None  # [B]: anchor jump
    seconds: Tensor | None = None  # [B]: wall time
    nfe: Tensor | None = None  # [B]: evaluations of the prior's network
    plans: Tensor | None = None  # [B, R, V, K, 2] m: at each of R replans
    targets: Tensor | None = (
        None  # [B, R, V] int64: whom each vehicle aims at, 0 the ego, -1 nobody
    )
    evasion: Tensor | None = (
        None  # [B, T+1, 4]: of the ego (metrics.evasion), NaN: none was found
    )
    driver: Tensor | None = (
        None  # [B, T+1, 4]: the competent driver in the ego's place, NaN: no collision
    )

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
        """Rollouts of scenes, those at index [B], with what these tell: sizes, types,
        recording, map and names.

        Args:
            scene: the batch of these scenes, where it is at hand.
            replays_ego: the ego is its recording, not simulated.
            known: further fields, among them adversaries, seed and eta.
        """
        scene = scenes.batch(index) if scene is None else scene
        start = scene["valid"]
        kind = scene["agent_type"]
        slots = (
            torch.arange(start.shape[1], device=start.device)
            < scene["route_log"].shape[1]
        )
        simulated = start & slots & (kind == VEHICLE)
        simulated[:, 0] &= not replays_ego
        names = {"scene_id": scenes.scene_id, "location": scenes.location}
        if (
            left_out := scene.get("left_out", None)
        ) is not None:  # scenes made by hand may lack it
            late = ~start & slots & (kind == VEHICLE) & valid.any(1)
            known["left_out"] = left_out - late.sum(-1)
        return cls(
            states=states,
            valid=valid,
            simulated=simulated,
            logged_valid=scene["logged_valid"] & start[:, None],
            **{
                name: scene[name]
                for name in ("size", "agent_type", "parked", "logged", *MAP)
            },
            **{
                name: [values[i] for i in index.tolist()]
                for name, values in names.items()
            },
            **known,
            batch_size=[len(index)],
        ).cpu()

    @classmethod
    def of(cls, rollouts: Sequence[Rollout]) -> "Rollouts":
        """Rollouts, padded to the longest; without plans, targets, evasion and driver,
        which drawings alone need."""
        parts: Any = [_of_one(rollout) for rollout in rollouts]
        joined: Any = torch.cat(parts)
        return joined

    @classmethod
    def from_npz(cls, paths: Path | Iterable[Path]) -> "Rollouts":
        """The rollouts of one or several files, padded. Raises InputError, naming the
        file, where one is damaged."""
        paths = [paths] if isinstance(paths, str | Path) else paths
        return cls.of([Rollout.read(path) for path in paths])

    def to_npz(self, folder: Path) -> list[Path]:
        """Write a file for each of B rollouts into a folder; returns their paths."""
        return [self.rollout(index).write(folder) for index in range(len(self))]

    def rollout(self, index: int) -> Rollout:
        """One of B rollouts as numpy arrays. Plans are those of the ego and of the
        adversaries."""
        row = self[index]
        known: dict[str, Any] = {}
        if row.plans is not None:
            planners = row.adversaries[: row.plans.shape[1]].bool().clone()
            planners[0] = True
            known["planners"] = planners.nonzero()[:, 0].numpy()
            known |= {
                "plans": row.plans[:, planners].float().numpy(),
                "targets": row.targets[:, planners].numpy(),
            }
        if row.routes is not None:
            others = row.states.shape[1] - len(row.routes)
            known["routes"] = np.pad(
                row.routes.numpy(), (0, others), constant_values=-1
            )
        texts: dict[str, Any] = {name: str(getattr(row, name) or "") for name in TEXTS}
        return Rollout(
            **texts,
            seed=int(row.seed),
            eta=float(row.eta),
            agent_type=np.array(AGENT_TYPES)[row.agent_type.numpy()],
            **{
                name: getattr(row, name).float().numpy()
                for name in ("states", "size", "logged")
            },
            **{
                name: getattr(row, name).numpy()
                for name in ("valid", "simulated", "adversaries", "logged_valid")
            },
            **vars(road_of(row)),
            ran_light=None if row.ran_light is None else row.ran_light.numpy(),
            evasion=_known_track(row.evasion),
            driver=_known_track(row.driver),
            **known,
        )


def _of_one(rollout: Rollout) -> Rollouts:
    """The rollout as Rollouts [1]."""
    tracks = ("states", "valid", "size", "simulated", "adversaries", "logged")
    others = ("logged_valid", "lane_points", "lane_width", "drivable_points")
    arrays: dict[str, Any] = {
        name: getattr(rollout, name) for name in (*tracks, *others)
    }
    arrays["agent_type"] = [AGENT_TYPES.index(kind) for kind in rollout.agent_type]
    for name in ("lane", "drivable"):  # the line number of each point
        counts = np.diff(getattr(rollout, f"{name}_offsets"))
        arrays[f"{name}_index"] = np.repeat(np.arange(len(counts)), counts)
    if rollout.ran_light is not None:
        arrays["ran_light"] = rollout.ran_light
    return Rollouts(
        **{name: torch.as_tensor(value)[None] for name, value in arrays.items()},
        seed=torch.tensor([rollout.seed]),
        eta=torch.tensor([rollout.eta], dtype=torch.float64),
        **{name: [getattr(rollout, name)] for name in TEXTS},
        batch_size=[1],
    )


_tensorclass_function = Rollouts.__torch_function__


def _torch_function(
    cls: type[Rollouts],
    func: Any,
    types: Any,
    args: tuple[Any, ...] = (),
    kwargs: dict[str, Any] | None = None,
) -> Any:
    """A tensor's function of Rollouts, `torch.cat` of those that differ in size or in
    what is known among them."""
    kwargs = dict(kwargs or {})
    if func is torch.cat:
        parts = aligned(args[0] if args else kwargs.pop("tensors"))
        args = (parts, *args[1:])
    return _tensorclass_function(func, types, args, kwargs)


Rollouts.__torch_function__ = classmethod(_torch_function)


def aligned(parts: Sequence[Rollouts]) -> list[Rollouts]:
    """Rollouts whose tensors have the same sizes but for B, padded, and that know the
    same."""
    columns: dict[str, list[Any]] = {}
    for name in Rollouts.__dataclass_fields__:
        values = [getattr(part, name) for part in parts]
        if any(value is None for value in values):
            columns[name] = [None] * len(parts)
        elif name not in (*TEXTS, "batch_size"):
            columns[name] = padded(values, fill=PADDING.get(name, 0))
    return [
        part.replace(**{name: column[index] for name, column in columns.items()})
        for index, part in enumerate(parts)
    ]


def padded(values: Sequence[Tensor], fill: float) -> list[Tensor]:
    """Tensors [B, ...] with the largest sizes among them in all dims but the first."""
    shape = [
        max(sizes) for sizes in zip(*(value.shape[1:] for value in values), strict=True)
    ]
    results = []
    for value in values:
        room = [
            end
            for size, most in zip(value.shape[1:], shape, strict=True)
            for end in (most - size, 0)
        ]
        results.append(
            torch.nn.functional.pad(value, room[::-1], value=fill)
            if any(room)
            else value
        )
    return results


def road_of(scene: Rollouts | TensorDictBase) -> Road:
    """The map of one scene or rollout, without its padding."""
    lanes, lane_offsets, whole = polylines(
        scene.get("lane_points"),
        scene.get("lane_index"),
        minimum=2,
    )
    rings, ring_offsets, _ = polylines(
        scene.get("drivable_points"),
        scene.get("drivable_index"),
        minimum=3,
    )
    return Road(
        lane_points=lanes,
        lane_offsets=lane_offsets,
        lane_width=scene.get("lane_width").float().numpy()[whole],
        drivable_points=rings,
        drivable_offsets=ring_offsets,
    )


def polylines(
    points: Tensor,
    index: Tensor,
    minimum: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points [M, 2] float32, offsets [L + 1] int64, line numbers [L]) of padded points
    [P, 2] with index [P].

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


def _known_track(track: Tensor | None) -> np.ndarray | None:
    """A track [T+1, 4] as an array; None where it is not known or has NaN."""
    return None if track is None or bool(track.isnan().any()) else track.float().numpy()
