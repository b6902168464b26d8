"""Readers of what a run writes and another one goes on with."""

import io
import json
import random
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from e2rl.evaluation.modes import read_modes
from e2rl.evaluation.provenance import leaves, origin_of
from e2rl.evaluation.resume import saved_choices, saved_configuration
from e2rl.evaluation.rollout_files import read_metrics, read_rows
from e2rl.evaluation.rollout_reader import as_rollout_dict, read_rollout
from e2rl.evaluation.table_comparison import compare_tables
from e2rl.learning.logging import read_choices
from e2rl.learning.run_checkpoint import load_checkpoint
from e2rl.metrics.score import score_rollouts
from e2rl.report.mode_table import mode_tables
from e2rl.report.tables import metric_tables, read_tables
from e2rl.run.errors import InputError
from e2rl.run.files import seal
from e2rl.run.parts import Kept
from e2rl.scenes.scene_list import read_list
from tools.fuzz.damage import ARRAYS, PLAIN, damaged, mutated, sealed, torch_file, with_header
from tools.fuzz.garbage import require, require_driven, same
from tools.fuzz.inputs import Inputs

HOSTILE = [
    "os.system",
    "builtins.exec",
    "subprocess.Popen",
    "tools.fuzz.damage.Calls",
    "hydra.utils.call",
    "${oc.env:HOME}",
]
STARTS = {"_target_": "e2rl.planners.external.ExternalEgo", "command": "touch mark"}


class Runs(Inputs):
    def rollouts(self, draw: random.Random) -> None:
        """Rollout files: bytes, and arrays of other kinds; what is read is scored."""
        whole = self.corpus.rollout
        buffer, arrays = io.BytesIO(), mutated(whole, draw, ARRAYS) if draw.random() < 0.7 else dict(whole)
        np.savez(buffer, **{name: np.asarray(value) for name, value in arrays.items()})
        content = buffer.getvalue()
        rollout = read_rollout(self.file("input.npz", content if draw.random() < 0.6 else damaged(content, draw)))
        require_driven(rollout)
        score_rollouts(as_rollout_dict([rollout]))

    def run_files(self, draw: random.Random) -> None:
        """metrics.json, modes.json, rollouts.csv, curriculum.csv, scenes.csv, tables.md, provenance.json: what reads
        them."""
        name, read = draw.choice(RUN_FILES)
        content = self.corpus.run_files[name]
        if name.endswith(".json") and draw.random() < 0.6:
            content = json.dumps(mutated(json.loads(content), draw, PLAIN)).encode()
        else:
            content = damaged(content, draw)
        read(self.file(f"run/{name}", content))

    def kept_parts(self, draw: random.Random) -> None:
        """Finished parts of a run: a damaged one is done again; one that was sealed anew may hold other numbers."""
        kept, value = Kept(self.folder, "stage"), self.corpus.part
        kept.save("part", ["x", 1], value)
        path = self.folder / "parts" / "stage" / "part.pt"
        content = torch_file(path.read_bytes(), draw, self.mark)
        path.write_bytes(content)
        found = kept.load("part", ["x", 1])
        if found is None:
            raise InputError("done again")
        require(sealed(content) or same(found, value), "another value")

    def checkpoints(self, draw: random.Random) -> None:
        """Checkpoints of a training: one of their files damaged, some sealed anew as a stranger would."""
        folder = self.folder / "checkpoint"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.corpus.checkpoint, folder)
        path = draw.choice(sorted(path for path in folder.rglob("*") if path.is_file()))
        whole = path.read_bytes()
        path.write_bytes(torch_file(whole, draw, self.mark) if path.suffix == ".pt" else damaged(whole, draw))
        if draw.random() < 0.5:
            for each in folder.glob("checkpoints/*"):
                seal(each)
        run = self.corpus.evolution
        load_checkpoint(folder, run)
        weights = run.ego.network.weights().values()
        require(all(bool(value.isfinite().all()) for value in weights), "weights of NaN")

    def weights(self, draw: random.Random) -> None:
        """Files of priors, actors and bits."""
        kind = draw.choice(["prior", "actor", "bits"])
        content = self.corpus.weights[kind]
        length = struct.unpack("<Q", content[:8])[0]
        way = draw.random()
        if way < 0.4:
            content = with_header(content, length, draw)
        elif way < 0.7:
            content = damaged(content[: 8 + length], draw) + content[8 + length :]
        else:
            content = damaged(content, draw)
        path = self.file(f"{kind}/{kind}.safetensors", content)
        require(same(self.corpus.loaded(kind, path), self.corpus.loaded(kind, None)), "other weights than were written")

    def configurations(self, draw: random.Random) -> None:
        """Configurations of a run that is resumed: none names code outside of e2rl."""
        config, names, odd = self.corpus.config, {}, [*PLAIN, *HOSTILE, STARTS]
        for name in ("config", "hydra"):
            names[name] = self.corpus.hydra[name]
            way = draw.random()
            if way < 0.5:
                names[name] = damaged(names[name], draw)
            elif way < 0.8:
                data = mutated(OmegaConf.to_container(OmegaConf.create(names[name].decode())), draw, odd)
                names[name] = OmegaConf.to_yaml(OmegaConf.create(data)).encode()
            self.file(f"resumed/.hydra/{name}.yaml", names[name])
        folder = self.folder / "resumed"
        saved = saved_configuration(config, folder, saved_choices("resume=input", folder), "resume=input")
        plain = OmegaConf.to_container(saved)
        require(not (named := [text for key, text in leaves(plain) if _is_code(key, text)]), f"it names {named[:1]}")


def _is_code(key: str, text: Any) -> bool:
    """Whether an entry of a configuration would run what is not e2rl's."""
    if "_target_" in key.rpartition(".")[2]:
        return bool(text) and not str(text).startswith("e2rl.")
    return ("${" in str(text) and ":" in str(text)) or (key.endswith("command") and text == STARTS["command"])


def _tables(path: Path) -> None:
    rows = read_metrics(path)
    metric_tables(rows)
    compare_tables(rows, rows)


def _scenes(path: Path) -> None:
    found = read_list(path)
    require(all(scene.scene_id and (scene.number or 0) >= 0 for scene in found), "a scene without a name")


def _modes(path: Path) -> None:
    mode_tables(read_modes(path))


RUN_FILES: list[tuple[str, Callable[[Path], Any]]] = [
    ("metrics.json", _tables),
    ("modes.json", _modes),
    ("rollouts.csv", read_rows),
    ("curriculum.csv", read_choices),
    ("scenes.csv", _scenes),
    ("tables.md", read_tables),
    ("provenance.json", lambda path: origin_of(path.parent)),
]
