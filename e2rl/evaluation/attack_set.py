"""Sets of attacks that were made against one planner, each with a file that others can
drive (docs/guide/compare.md)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from e2rl.run.errors import InputError
from e2rl.run.files import check_format, misfit, write_atomically
from e2rl.run.parts import read_state, state_bytes
from e2rl.run.run import read_provenance
from e2rl.scenes.scene import content_hash
from e2rl.scenes.scene_list import read_list
from e2rl.sim.rollout_file import ROLLOUTS, Rollout, rollout_name
from e2rl.traffic.attack_replay import AttackTracks

FORMAT = "e2rl-attacks/1"
ENDING = ".attacks"  # of the file of a set
KEPT = {"preventable": "cfr_preventable", "hit": "cfr", "all": ""}  # columns that are 1
# of rollouts.csv, what is kept of each attack
ATTACK = {
    **dict.fromkeys(("scene_id", "method"), str),
    "seed": int,
    **dict.fromkeys(("eta", "cfr", "cfr_preventable"), float),
    **dict.fromkeys(("transport", "transport_adversary"), float),
}


@dataclass(frozen=True)
class AttackSet:
    """Attacks that were made against one planner.

    Args:
        ego: the planner.
        rows: of each attack what ATTACK names.
        tracks: what they drove.
        scenes: SHA-256 of each scene.
        origin: versions, weights, data and command that they were made by.
    """

    ego: str
    rows: list[dict[str, Any]]
    tracks: AttackTracks
    scenes: dict[str, str]
    origin: dict[str, str]

    @classmethod
    def of_run(
        cls, run: Path, rows: Sequence[Mapping], begun: Path
    ) -> "list[AttackSet]":
        """Returns a set for each planner in rows of rollouts.csv.

        Args:
            run: folder of the rollouts' files.
            rows: of the attacks, none of which errored.
            begun: folder with the list of scenes and the provenance of the run.

        Raises:
            InputError: where a file is missing, damaged or of another version.
        """
        provenance = read_provenance(begun)
        origin = {"command": provenance["command"], **provenance["versions"][-1]}
        for kind in ("inputs", "files"):
            texts = provenance[kind].items()
            origin |= {name: text for name, text in texts if isinstance(text, str)}
        hashes = {line.scene_id: line.sha256 or "" for line in read_list(begun)}
        by_ego: dict[str, list[Mapping]] = {}
        for row in rows:
            by_ego.setdefault(row["ego_policy"], []).append(row)
        return [
            cls(
                ego,
                [{name: row[name] for name in ATTACK} for row in attacks],
                tracks=tracks_of(run / ROLLOUTS, attacks),
                scenes={row["scene_id"]: hashes[row["scene_id"]] for row in attacks},
                origin=origin,
            )
            for ego, attacks in by_ego.items()
        ]

    @classmethod
    def read(cls, path: Path) -> "AttackSet":
        """Returns the set in a file; InputError where a byte of it changed, or it is
        none."""
        mend = "give a file of e2rl export RUN --to attacks"
        try:
            content = read_state(path)
            check_format(path, content.pop("format"), expected=FORMAT, mend=mend)
            tracks = AttackTracks(**content.pop("tracks"))
            attacks = cls(tracks=tracks, **content)
            shape = {"ego": str, "rows": [ATTACK], "scenes": {...: str}}
            if reason := misfit(vars(attacks), shape):
                raise ValueError(reason)
            attacks.check_shapes()
        except InputError:
            raise
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise InputError(f"{path}: no set of attacks ({error}); {mend}") from error
        return attacks

    def check_shapes(self) -> None:
        """Raises ValueError where the tracks are not those of the rows."""
        count, frames, agents, _ = self.tracks.states.shape
        shapes = {
            "states": ((count, frames, agents, 4), torch.float32),
            "valid": ((count, frames, agents), torch.bool),
            "adversaries": ((count, agents), torch.bool),
            "routes": ((count, agents), torch.int64),
            "nats": ((count, 2), torch.float32),
        }
        for name, expected in shapes.items():
            value = getattr(self.tracks, name)
            if (tuple(value.shape), value.dtype) != expected or count != len(self.rows):
                raise ValueError(f"{name} has shape {list(value.shape)}")

    def write(self, path: Path) -> Path:
        """Write its file, which begins with the hash of its content; returns the path."""
        content = vars(self) | {"format": FORMAT, "tracks": vars(self.tracks)}
        write_atomically(path, state_bytes(content))
        return path

    @property
    def digest(self) -> str:
        """SHA-256 of the tracks."""
        arrays = {name: value.numpy() for name, value in vars(self.tracks).items()}
        return content_hash(arrays)

    def check_scenes(
        self, hashes: Mapping[str, str | None], sizes: Sequence[int]
    ) -> None:
        """Raises InputError where the data hold other scenes than those of the attacks.

        Args:
            hashes: SHA-256 of each scene of the data.
            sizes: frames and agents of each.
        """
        for name, sha256 in self.scenes.items():
            if hashes.get(name) != sha256:
                raise InputError(
                    f"attacks on {self.ego}: scene {name} is not in the data, or another "
                    "there; give the data, data.build and num_scenes of their run"
                )
        if list(self.tracks.valid.shape[1:]) != list(sizes):
            raise InputError(
                f"attacks on {self.ego}: frames and agents are "
                f"{list(self.tracks.valid.shape[1:])}, those of the scenes {list(sizes)}; "
                "set data.build as in their run"
            )


def kept(rows: Sequence[Mapping], keep: str) -> list[Mapping]:
    """Returns the rows of rollouts that have a file, and of these those of KEPT."""
    ended = [row for row in rows if row["errored"] != 1]
    return [row for row in ended if not KEPT[keep] or row[KEPT[keep]] == 1]


def tracks_of(folder: Path, rows: Sequence[Mapping]) -> AttackTracks:
    """Returns what attacks drove, from their rollouts' files; InputError as
    `AttackSet.of_run`."""
    arrays: dict[str, list] = {name: [] for name in ("states", "valid", "adversaries")}
    arrays["routes"] = []
    for row in rows:
        path = folder / rollout_name(row)
        rollout = Rollout.read(path, folder)
        if rollout.routes is None:
            raise InputError(
                f"{path}: holds no routes, of an older version; make its run again"
            )
        for name, values in arrays.items():
            values.append(torch.from_numpy(getattr(rollout, name)))
    nats = []
    for row in rows:
        adversaries = row["transport_adversary"]
        nats.append([adversaries, row["transport"] - adversaries])
    stacked = {name: torch.stack(values) for name, values in arrays.items()}
    return AttackTracks(**stacked, nats=torch.tensor(nats, dtype=torch.float32))


def named(sets: Sequence[AttackSet]) -> dict[str, AttackSet]:
    """Returns the sets by the names of their planners, further ones of one planner with
    a number."""
    result: dict[str, AttackSet] = {}
    for attacks in sets:
        name = attacks.ego
        number = 1
        while name in result:
            number += 1
            name = f"{attacks.ego}-{number}"
        result[name] = attacks
    return result
