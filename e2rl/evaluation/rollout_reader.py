"""Rollout files read as arrays, and as the dict of tensors that the metrics take."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile
from zlib import error as ZlibError

import numpy as np
import torch
from torch import Tensor

from e2rl.errors import InputError
from e2rl.evaluation.files import FORMAT, OPTIONAL, ROLLOUTS
from e2rl.scene.recording import AGENT_TYPES

SCALARS = ("format", "scene_id", "location", "dataset", "split", "method", "ego_policy", "seed", "eta", "dt", "ego")
ARRAYS = (
    "states",
    "valid",
    "size",
    "agent_type",
    "simulated",
    "adversaries",
    "logged",
    "logged_valid",
    "lane_points",
    "lane_offsets",
    "lane_width",
    "drivable_points",
    "drivable_offsets",
)


def read_rollout(path: Path) -> dict[str, Any]:
    """The arrays of one npz, scalars as python values; InputError if it is no rollout."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            data = {key: archive[key] for key in archive.files}
    except (OSError, ValueError, EOFError, BadZipFile, ZlibError) as error:
        raise InputError(f"{path}: no readable rollout ({error}); run evaluate.py again to rewrite it") from error
    missing = [key for key in (*SCALARS, *ARRAYS) if key not in data]
    if missing or str(data["format"]) != FORMAT:
        raise InputError(
            f"{path}: not of format {FORMAT} (missing: {', '.join(missing) or 'nothing'}; format: "
            f"{data.get('format')}); give a folder that evaluate.py wrote"
        )
    return {key: value.item() if key in SCALARS else value for key, value in data.items()}


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
