"""Rollout files read as arrays, and as the dict of tensors that the metrics take."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from e2rl.evaluation.rollout_files import FORMAT, OPTIONAL, ROLLOUTS
from e2rl.run.errors import InputError
from e2rl.run.files import read_arrays
from e2rl.scenes.recording import AGENT_TYPES

TEXTS = ("format", "scene_id", "location", "dataset", "split", "method", "ego_policy")
WHOLE = ("seed", "ego")
SCALARS = (*TEXTS, *WHOLE, "eta", "dt")
MOST = 1e6  # intensity
FARTHEST, FASTEST, LONGEST, TURNED = 1e5, 150.0, 100.0, 1e3  # m, m/s, m and rad of an agent
ARRAYS = {  # kinds of elements, and shape: a number, or a letter for a size that is the same wherever it stands
    "states": ("f", "TN4"),
    "valid": ("b", "TN"),
    "size": ("f", "N2"),
    "agent_type": ("U", "N"),
    "simulated": ("b", "N"),
    "adversaries": ("b", "N"),
    "logged": ("f", "TN4"),
    "logged_valid": ("b", "TN"),
    "lane_points": ("f", "M2"),
    "lane_offsets": ("iu", "L"),
    "lane_width": ("f", "W"),
    "drivable_points": ("f", "D2"),
    "drivable_offsets": ("iu", "Q"),
    "ran_light": ("iu", "N"),
}
PLANS = {"planners": ("iu", "P"), "plans": ("f", "KPH2"), "targets": ("iu", "KP")}  # none or all of them
EXTRAS = {"evasion": ("f", "T4"), **PLANS}


def read_rollout(path: Path) -> dict[str, Any]:
    """The arrays of one npz, scalars as python values; InputError if it is no rollout."""
    path = Path(path)
    try:
        data = read_arrays(path)
    except ValueError as error:
        raise InputError(f"{path}: no readable rollout ({error}); run evaluate.py again to rewrite it") from error
    missing = [key for key in (*SCALARS, *ARRAYS) if key not in data and key not in OPTIONAL]
    if missing or str(data["format"]) != FORMAT:
        raise InputError(
            f"{path}: not of format {FORMAT} (missing: {', '.join(missing) or 'nothing'}; format: "
            f"{data.get('format')}); give a folder that evaluate.py wrote"
        )
    if wrong := _misfits(data):
        raise InputError(f"{path}: damaged: {wrong}; run evaluate.py again to rewrite it")
    return plain(data)


def plain(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The arrays of a rollout (`evaluation.files.rollout_arrays`), scalars as python values."""
    return {key: value.item() if key in SCALARS else value for key, value in arrays.items()}


def _misfits(data: dict[str, np.ndarray]) -> str | None:
    """What does not fit together in the arrays of a rollout; None: nothing."""
    for key in SCALARS:
        kind = "U" if key in TEXTS else "iu" if key in WHOLE else "iuf"
        if data[key].shape != () or data[key].dtype.kind not in kind:
            return f"{key} is no single {'text' if key in TEXTS else 'number'}"
    sizes: dict[str, int] = {}
    for key, (kinds, shape) in (ARRAYS | EXTRAS).items():
        if key not in data:
            continue
        array = data[key]
        wrong = f"{key} has shape {array.shape} and type {array.dtype}"
        if array.ndim != len(shape) or array.dtype.kind not in kinds:
            return wrong
        for name, size in zip(shape, array.shape, strict=True):
            if sizes.setdefault(name, int(name) if name.isdigit() else size) != size:
                return wrong
    if min(sizes["T"], sizes["N"]) < 1 or sizes["L"] != sizes["W"] + 1:
        return "it holds no agent, or as many lanes as borders between them"
    if len(data.keys() & PLANS) not in (0, len(PLANS)):
        return f"of {', '.join(PLANS)} some are missing"
    return _odd_numbers(data, sizes["N"]) or _odd_agents(data) or _odd_map(data)


def _odd_numbers(data: dict[str, np.ndarray], agents: int) -> str | None:
    """Which of the single numbers and of the agents' numbers is out of range."""
    bounds = {"ego": (0, agents - 1), "seed": (0, np.inf), "eta": (0, MOST), "dt": (1e-3, 1)}
    bounds |= {"planners": (0, agents - 1), "targets": (-1, agents - 1)}
    for name, (low, high) in bounds.items():
        if name in data and not ((data[name] >= low) & (data[name] <= high)).all():  # NaN is not, either
            return f"{name} is out of range"
    return None


def _odd_agents(data: dict[str, np.ndarray]) -> str | None:
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


def _odd_map(data: dict[str, np.ndarray]) -> str | None:
    """Which lines of the map are not divided, or are NaN or infinite."""
    for name in ("lane", "drivable"):
        offsets = data[f"{name}_offsets"].astype(np.int64)
        ends = (offsets[:1].tolist(), offsets[-1:].tolist())
        if ends != ([0], [len(data[f"{name}_points"])]) or (np.diff(offsets) < 0).any():
            return f"{name}_offsets do not divide {name}_points"
        if not np.isfinite(data[f"{name}_points"]).all():
            return f"{name}_points are NaN or infinite"
    return None if np.isfinite(data["lane_width"]).all() else "lane_width is NaN or infinite"


def read_rollouts(folder: Path) -> list[dict[str, Any]]:
    """All rollouts of a folder (or of a run's folder), sorted by name."""
    folder = Path(folder)
    paths = sorted((folder / ROLLOUTS if (folder / ROLLOUTS).is_dir() else folder).glob("*.npz"))
    if not paths:
        raise InputError(f"{folder}: no rollouts (*.npz) here; give the folder of a run that evaluate.py wrote")
    return [read_rollout(path) for path in paths]


def as_rollout_dict(rollouts: Sequence[dict]) -> dict:
    """The rollout dict of tensors (leading B, padded) of rollouts read from files, ready for score_rollouts.

    `seconds`, passes and transport are not in the files: seconds are NaN, the others absent.
    """

    def pad(name: str, fill: float) -> Tensor:
        arrays = [torch.as_tensor(rollout[name]) for rollout in rollouts]
        shape = [max(sizes) for sizes in zip(*(array.shape for array in arrays), strict=True)]
        result = torch.full((len(arrays), *shape), fill, dtype=arrays[0].dtype)
        for row, array in zip(result, arrays, strict=True):
            row[tuple(slice(length) for length in array.shape)] = array
        return result

    result: dict[str, Any] = {
        name: pad(name, 0)
        for name in (
            "states",
            "valid",
            "size",
            "simulated",
            "adversaries",
            "logged",
            "logged_valid",
            "lane_points",
            "lane_width",
            "drivable_points",
        )
    }
    result |= {name: pad(name, -1) for name in OPTIONAL if all(name in rollout for rollout in rollouts)}
    codes = [
        {
            "agent_type": np.array([AGENT_TYPES.index(kind) for kind in rollout["agent_type"]], np.int64),
            "lane_index": line_numbers(rollout["lane_offsets"]),
            "drivable_index": line_numbers(rollout["drivable_offsets"]),
        }
        for rollout in rollouts
    ]
    for name in codes[0]:
        arrays = [torch.as_tensor(code[name]) for code in codes]
        fill = -1 if name.endswith("index") else 0
        result[name] = torch.nn.utils.rnn.pad_sequence(arrays, batch_first=True, padding_value=fill)
    result |= {name: [rollout[name] for rollout in rollouts] for name in ("scene_id", "location")}
    return result | {
        "seed": torch.tensor([rollout["seed"] for rollout in rollouts]),
        "eta": torch.tensor([rollout["eta"] for rollout in rollouts], dtype=torch.float64),
        "seconds": torch.full((len(rollouts),), torch.nan),
    }


def line_numbers(offsets: np.ndarray) -> np.ndarray:
    """The line number of each point [M] of lines that start and end at offsets [L + 1]."""
    return np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
