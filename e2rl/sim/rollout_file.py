"""The file of a rollout: an npz of format e2rl-rollout/1, readable without pickle
(docs/reference/metrics.md)."""

import hashlib
import io
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from e2rl.run.errors import InputError
from e2rl.run.files import (
    check_format,
    open_regular,
    read_arrays,
    write_atomically,
)
from e2rl.scenes.recording import DT

FORMAT = "e2rl-rollout/1"
ROLLOUTS = "rollouts"  # folder of a run with a file per rollout
MAX_BYTES = 1 << 27  # of a file, unpacked
# Part of a file name that stands for itself.
PLAIN = re.compile(r"[a-z0-9.@+-]+(_[a-z0-9.@+-]+)*")
STEM = 200  # characters of a file name without its ending
DIGITS = 10  # characters of the hash after it
# Also what turns text round.
UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def array(kinds: str, shape: str, **options: Any) -> Any:
    """A field of a rollout file.

    Args:
        kinds: numpy's kinds of elements that it may have: U text, b bool, i and u whole
            numbers, f floats.
        shape: per axis a size, or a letter for a size that is the same wherever the
            letter stands; "": one value.
        options: of the dataclass's field.
    """
    return field(metadata={"kinds": kinds, "shape": shape}, **options)


@dataclass(kw_only=True)
class Road:
    """A map without padding: lane l is lane_points[lane_offsets[l]:lane_offsets[l +
    1]], drivable polygons alike."""

    lane_points: np.ndarray = array("f", "M2")
    lane_offsets: np.ndarray = array("iu", "L")
    lane_width: np.ndarray = array("f", "W")
    drivable_points: np.ndarray = array("f", "D2")
    drivable_offsets: np.ndarray = array("iu", "Q")

    def lanes(self) -> list[np.ndarray]:
        """Centreline [P, 2] m of each lane."""
        return [
            part
            for part in np.split(self.lane_points, self.lane_offsets[1:-1])
            if len(part)
        ]

    def polygons(self) -> list[np.ndarray]:
        """Ring [P, 2] m of each drivable polygon."""
        return [
            part
            for part in np.split(self.drivable_points, self.drivable_offsets[1:-1])
            if len(part)
        ]


@dataclass(kw_only=True)
class Rollout(Road):
    """One rollout as numpy arrays without padding: the content of its file.

    Optional are `ran_light` [N], the step at which each vehicle last crossed a stop
    line at red; `routes` [N], the route candidates that they followed, -1 none;
    `evasion` and `driver` [T+1, 4], the ego as the search for evasions and as the
    competent driver of the verdict drive it; `plans` [R, P, K, 2] m and `targets`
    [R, P] of the agents `planners` [P] at each of R replans.
    """

    scene_id: str = array("U", "")
    location: str = array("U", "")
    dataset: str = array("U", "")
    split: str = array("U", "")
    method: str = array("U", "")
    ego_policy: str = array("U", "")
    seed: int = array("iu", "")
    eta: float = array("iuf", "")
    dt: float = array("iuf", "", default=DT)
    ego: int = array("iu", "", default=0)
    states: np.ndarray = array("f", "TN4")
    valid: np.ndarray = array("b", "TN")
    size: np.ndarray = array("f", "N2")
    agent_type: np.ndarray = array("U", "N")
    simulated: np.ndarray = array("b", "N")
    adversaries: np.ndarray = array("b", "N")
    logged: np.ndarray = array("f", "TN4")
    logged_valid: np.ndarray = array("b", "TN")
    ran_light: np.ndarray | None = array("iu", "N", default=None)
    routes: np.ndarray | None = array("iu", "N", default=None)
    evasion: np.ndarray | None = array("f", "T4", default=None)
    driver: np.ndarray | None = array("f", "T4", default=None)
    planners: np.ndarray | None = array("iu", "P", default=None)
    plans: np.ndarray | None = array("f", "KPH2", default=None)
    targets: np.ndarray | None = array("iu", "KP", default=None)

    @property
    def name(self) -> str:
        """Name of its file."""
        return rollout_name(vars(self))

    @classmethod
    def read(cls, path: Path, within: Path | None = None) -> "Rollout":
        """The rollout of a file, which lies in the folder `within` once links are
        followed. Raises InputError, naming the file, where it is none."""
        path = Path(path)
        try:
            with open_regular(path, MAX_BYTES, within=within) as file:
                data = read_arrays(file, MAX_BYTES)
        except (OSError, ValueError) as error:
            raise InputError(
                f"{path}: no readable rollout ({error}); run evaluate.py again to rewrite it"
            ) from error
        check_format(
            path,
            data.get("format"),
            expected=FORMAT,
            mend="give a folder that evaluate.py of this version wrote",
        )
        present = [entry for entry in fields(cls) if entry.name in data]
        missing = [
            entry.name
            for entry in fields(cls)
            if entry.default is not None and entry.name not in data
        ]
        wrong = f"no {', '.join(missing)}" if missing else _misfit(data, present)
        if wrong:
            raise InputError(
                f"{path}: damaged: {wrong}; run evaluate.py again to rewrite it"
            )
        values: dict[str, Any] = {entry.name: data[entry.name] for entry in present}
        for name, value in values.items():
            values[name] = value if value.shape else value.item()
        return cls(**values)

    def write(self, folder: Path) -> Path:
        """Write its file into a folder, whole or not at all; returns its path."""
        arrays: dict[str, Any] = {
            name: np.asarray(value)
            for name, value in vars(self).items()
            if value is not None
        }
        buffer = io.BytesIO()
        np.savez_compressed(buffer, format=np.array(FORMAT), **arrays)
        path = Path(folder) / self.name
        write_atomically(path, buffer.getvalue())
        return path


@dataclass(frozen=True)
class Failure:
    """A rollout with its row of rollouts.csv: what happened and what verdicts say."""

    rollout: Rollout
    row: Mapping[str, Any]

    @classmethod
    def read(cls, run: Path, row: Mapping[str, Any]) -> "Failure":
        """The failure of a row of a run's table, with the rollout from its file;
        InputError where they do not fit."""
        path = Path(run) / ROLLOUTS / rollout_name(row)
        rollout = Rollout.read(path, run)
        steps, agents = rollout.valid.shape
        step = row["contact_step"]
        within = step in range(steps) and row["partner"] in range(agents)
        if rollout.name != path.name or (step == step and not within):
            raise InputError(
                f"{path}: does not fit to its row of the table; run evaluate.py again "
                f"to rewrite both"
            )
        return cls(rollout, row)

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
    """Name of the file of a row or rollout."""
    return f"{rollout_key(row)}.npz"


def rollout_key(row: Mapping[str, Any]) -> str:
    """<method>__<ego>__<eta>__<scene_id>__<seed> of a row or rollout, as `file_stem`
    writes it."""
    eta = float(row["eta"])
    short = f"{eta:g}" if float(f"{eta:g}") == eta else eta
    return file_stem(
        row["method"],
        row["ego_policy"],
        short,
        row["scene_id"],
        row["seed"],
    )


def file_stem(*parts: object) -> str:
    """The parts, joined by '__', as a file name without its ending; other parts have
    another name.

    Others than letters, digits and . _ @ + - become '-', and long names are cut. Then,
    and where a part has capitals, which some file systems do not tell apart, a hash of
    the parts follows after '~'.
    """
    texts = [str(part) for part in parts]
    stem = "__".join(re.sub(r"[^A-Za-z0-9._@+-]", "-", text) for text in texts)
    if len(stem) <= STEM and all(map(PLAIN.fullmatch, texts)):
        return stem
    return f"{stem[:STEM]}~{hashlib.sha256(json.dumps(texts).encode()).hexdigest()[:DIGITS]}"


def _misfit(data: Mapping[str, np.ndarray], present: Iterable[Field]) -> str | None:
    """Which array of a file has another type or shape than its field; None: none."""
    sizes: dict[str, int] = {}
    for entry in present:
        value = data[entry.name]
        kinds = entry.metadata["kinds"]
        shape = entry.metadata["shape"]
        if not shape and (value.shape != () or value.dtype.kind not in kinds):
            return f"{entry.name} is no single {'text' if kinds == 'U' else 'number'}"
        if not shape and kinds == "U" and UNPRINTABLE.search(value.item()):
            return f"{entry.name} holds control characters"
        wrong = value.ndim != len(shape) or value.dtype.kind not in kinds
        if wrong or any(
            sizes.setdefault(letter, int(letter) if letter.isdigit() else size) != size
            for letter, size in zip(shape, value.shape, strict=True)
        ):
            return f"{entry.name} has shape {value.shape} and type {value.dtype}"
    if min(sizes["T"], sizes["N"]) < 1 or sizes["L"] != sizes["W"] + 1:
        return "it holds no agent, or as many lanes as borders between them"
    if len(data.keys() & {"planners", "plans", "targets"}) not in (0, 3):
        return "of planners, plans, targets some are missing"
    return None
