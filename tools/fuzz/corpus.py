"""Whole inputs for the fuzzer, made by e2rl itself; recorded logs where they are given."""

import json
import pickle
import re
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from e2rl.api import load_config
from e2rl.evaluation.methods import build_ego
from e2rl.evaluation.protocol import Method, Setup, run_protocol
from e2rl.learning.build import build_evolution
from e2rl.learning.evolution import Evolution
from e2rl.learning.logging import write_choices
from e2rl.learning.run_checkpoint import save_checkpoint
from e2rl.planners.actor import ActorEgo
from e2rl.planners.bits_network import BitsNetwork, load_bits, save_bits
from e2rl.planners.idm_planner import IDMEgo
from e2rl.planners.network import ActorCritic
from e2rl.prior.checkpoint import load_prior, save_prior
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.prior import Prior
from e2rl.report.tables import metric_tables, save_tables
from e2rl.run.config import resolved
from e2rl.scenes.builder import BuildSettings
from e2rl.scenes.bundled import BundledSource, load_recordings
from e2rl.scenes.recording import AGENT_TYPES, Recording
from e2rl.scenes.scenarionet import ScenarioNetSource, safe_load
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.scene_list import SCENES, list_text
from e2rl.sim.env import SimSettings
from e2rl.traffic.rule_based import ConstantVelocity, Replay

LASTS = re.compile(rb"<time>\s*<exact>6\d</exact>")  # a CommonRoad scenario of six seconds
SMALL = BuildSettings(steps=20, vehicles=4, others=2, vertices=40, field_cells=32)
TINY = ["learner.collect.batch=2", "learner.collect.steps=20", "learner.collect.hold=1", "learner.collect.iterations=1"]
TINY += ["learner.react=null", "learner.ppo.teaching=0", "learner.ppo.cloning=0", "ego.hidden=[8]", "rounds=2"]


def description(recording: Recording) -> dict:
    """A recording as a ScenarioDescription."""
    states, valid = recording.states, recording.valid

    def track(index: int) -> dict:
        x, y, heading, speed = states[:, index].T
        state = {"position": np.stack([x, y, 0 * x], -1), "heading": heading, "valid": valid[:, index]}
        state |= {"velocity": speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)}
        state |= {name: np.full(len(x), recording.size[index, k]) for k, name in enumerate(("length", "width"))}
        return {"type": AGENT_TYPES[recording.agent_type[index]].upper(), "state": state}

    lanes = {
        name: {"type": "LANE_SURFACE_STREET", "polyline": lane.points, "exit_lanes": lane.exits, "width": np.zeros(0)}
        for name, lane in recording.lanes.items()
    }
    metadata = {"sdc_id": str(recording.ego), "ts": np.arange(len(states)) * 0.1, "current_time_index": 10}
    tracks = {str(index): track(index) for index in range(states.shape[1])}
    return {
        "id": recording.scene_id,
        "tracks": tracks,
        "map_features": lanes,
        "metadata": metadata,
        "dynamic_map_states": {},
    }


class Corpus:
    """Whole inputs by kind, each made when it is first asked for; in a folder."""

    def __init__(self, folder: Path, data: str | None, commonroad: str | None, argoverse2: str | None) -> None:
        self.folder, self._data, self._commonroad, self._argoverse2 = folder, data, commonroad, argoverse2

    @cached_property
    def descriptions(self) -> list[dict]:
        if self._data:
            source = ScenarioNetSource(self._data)
            return [safe_load(source.content(log), log) for log in source.logs()[:8]]
        return [description(recording) for recording in load_recordings("tune")[:8]]

    @cached_property
    def pickles(self) -> list[bytes]:
        return [pickle.dumps(scene, protocol) for scene in self.descriptions[:3] for protocol in (0, 2, 4)]

    @cached_property
    def commonroad(self) -> list[bytes]:
        from e2rl.scenes.commonroad import CommonRoadSource

        source = CommonRoadSource(self._commonroad)
        contents = [source.content(log) for log in source.logs()]
        long = [content for content in contents if LASTS.search(content)]
        return sorted(long or contents, key=len)[:4]

    @cached_property
    def argoverse2(self) -> list[Path]:
        from e2rl.scenes.argoverse2 import Argoverse2Source, _files

        source = Argoverse2Source(self._argoverse2)
        return _files(source.root() / source.logs()[0])

    @cached_property
    def scenes(self) -> SceneSet:
        return BundledSource(cache=str(self.folder / "cache"), workers=1, build=SMALL).load(3)

    @cached_property
    def cache(self) -> bytes:
        assert len(self.scenes)  # builds it
        (path,) = (self.folder / "cache").glob("scenes-*.packed")
        return path.read_bytes()

    @cached_property
    def _run(self) -> Path:
        """The files of a small evaluation."""
        folder = self.folder / "evaluation"
        setup = Setup(self.scenes, IDMEgo(), "idm", SimSettings(), 4)
        methods = [Method("replay", Replay()), Method("constant_velocity", ConstantVelocity(), 2.0)]
        save_tables(folder / "tables.md", metric_tables(run_protocol(setup, methods, [0, 1], folder)))
        choice = {"round": 0, "eta": 1.0, "template": "full", "draws": 3, "left_out": 0, "episodes": 4, "failures": 1}
        write_choices(folder / "curriculum.csv", [choice | {"failure_rate": 0.25, "value": float("nan")}])
        (folder / SCENES).write_text(list_text(self.scenes))
        known = {"command": "python evaluate.py", "versions": [{"git": "0"}], "settings": {"eta": 2.0}, "inputs": {}}
        (folder / "provenance.json").write_text(json.dumps(known))
        return folder

    @cached_property
    def run_files(self) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in self._run.iterdir() if path.is_file()}

    @cached_property
    def rollout(self) -> dict[str, np.ndarray]:
        path = sorted((self._run / "rollouts").glob("*.npz"))[0]
        with np.load(path) as arrays:
            return dict(arrays)

    @cached_property
    def part(self) -> Any:
        row = {"scene_id": "a", "cfr": 0.5, "seed": 1, "duty": ""}
        return [[row, row], [{"speed": torch.arange(5.0), "turn": torch.zeros(3, 2)}], [{"reason": "raised A"}]]

    @cached_property
    def evolution(self) -> Evolution:
        torch.manual_seed(0)
        config = load_config("train", TINY)
        return build_evolution(config, self.scenes, build_ego(config), Replay(), folder=self.folder / "training")

    @cached_property
    def checkpoint(self) -> Path:
        save_checkpoint(self.folder / "training", self.evolution, resolved(load_config("train", TINY)))
        return self.folder / "training"

    @cached_property
    def weights(self) -> dict[str, bytes]:
        torch.manual_seed(0)
        settings = DenoiserSettings(width=8, blocks=1, heads=1)
        prior = save_prior(Prior(settings), self.folder, {"data": "none"})
        ActorEgo(hidden=(8,)).network.save(self.folder / "actor.safetensors")
        save_bits(BitsNetwork(8), self.folder / "bits.safetensors", {"data": "none"})
        files = {"prior": prior, "actor": self.folder / "actor.safetensors", "bits": self.folder / "bits.safetensors"}
        return {kind: path.read_bytes() for kind, path in files.items()}

    def loaded(self, kind: str, path: Path | None) -> dict[str, torch.Tensor]:
        """The weights in a file; None: those that were written."""
        if path is None:
            if kind not in self._whole:
                whole = self.folder / "whole" / f"{kind}.safetensors"
                whole.parent.mkdir(exist_ok=True)
                whole.write_bytes(self.weights[kind])
                self._whole[kind] = self.loaded(kind, whole)
            return self._whole[kind]
        if kind == "prior":
            return dict(load_prior(str(path))[0].state_dict())
        if kind == "bits":
            return dict(load_bits(str(path)).state_dict())
        network: ActorCritic = ActorEgo(hidden=(8,)).network
        network.load(path)
        return network.weights()

    @cached_property
    def _whole(self) -> dict[str, dict[str, torch.Tensor]]:
        return {}

    @cached_property
    def config(self) -> DictConfig:
        """Of the command line that resumes."""
        return load_config("train", ["resume=input"])

    @cached_property
    def hydra(self) -> dict[str, bytes]:
        choices = {"ego": "actor", "data": "bundled", "synthesizer": "e2", "learner": "ppo_bc"}
        about = {"hydra": {"runtime": {"choices": choices, "cwd": "."}}}
        return {
            "config": OmegaConf.to_yaml(load_config("train")).encode(),
            "hydra": OmegaConf.to_yaml(OmegaConf.create(about)).encode(),
        }
