"""Who applies the criteria of Sec. IV-A2: the rules, or a language model behind their interface.

The model is asked about all vehicles of a scene in one request, about the scenes of a batch at the same time. Its
answers are kept on disk by content. Wherever it fails, the rules decide for that scene, and this is counted.
"""

import hashlib
import json
import os
import tempfile
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from tensordict import TensorDictBase

from e2rl.errors import InputError
from e2rl.sim.world import World
from e2rl.synthesizer.description import describe_ego, describe_vehicle, present_vehicles
from e2rl.synthesizer.feasibility import Feasibility, FeasibilitySettings, feasible_vehicles
from e2rl.synthesizer.prompt import SCHEMA, Verdicts, messages, read_answer

KINDS = ("rules", "lm")
FORMAT = {"type": "json_schema", "json_schema": {"name": "feasibility", "strict": True, "schema": SCHEMA}}
COUNTS = ("lm_scenes", "lm_requests", "lm_cached", "lm_fallbacks")
Reasoner = Callable[[TensorDictBase, World, FeasibilitySettings], Feasibility]


@dataclass(frozen=True)
class ReasonerSettings:
    """Fields: `reasoner` in conf/synthesizer/e2.yaml."""

    kind: str = "rules"
    model: str | None = None
    base_url: str | None = None
    timeout: float = 30.0
    retries: int = 1
    workers: int = 8
    cache: str = ".cache/reasoner"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"synthesizer.reasoner.kind={self.kind}: choose one of {', '.join(KINDS)}")
        if self.kind == "lm" and not self.model:
            raise InputError("synthesizer.reasoner.kind=lm: name a model with synthesizer.reasoner.model=NAME")
        if self.timeout <= 0 or self.retries < 0 or self.workers < 1:
            raise InputError("synthesizer.reasoner: timeout must be positive, retries at least 0, workers at least 1")


def build_reasoner(settings: ReasonerSettings, statistics: dict[str, float]) -> Reasoner:
    """The rules, or a LanguageReasoner that counts in `statistics`."""
    return feasible_vehicles if settings.kind == "rules" else LanguageReasoner(settings, statistics)


class LanguageReasoner:
    """Asks an OpenAI-compatible endpoint; called as `feasible_vehicles` is.

    statistics: lm_scenes judged, lm_requests sent, lm_cached answers, lm_fallbacks (scenes that the rules decided). The
    first fallback warns, and every tenfold of it.
    """

    def __init__(self, settings: ReasonerSettings, statistics: dict[str, float]) -> None:
        try:
            import openai
        except ImportError as error:
            raise InputError(
                "synthesizer.reasoner.kind=lm: the openai client is not installed; install e2rl with its "
                "extra: pip install 'e2rl[lm]'"
            ) from error
        try:
            self._client = openai.OpenAI(
                base_url=settings.base_url, timeout=settings.timeout, max_retries=settings.retries
            )
        except openai.OpenAIError as error:
            raise InputError(
                f"synthesizer.reasoner.kind=lm: {str(error).splitlines()[0]} (for an endpoint without "
                "keys any OPENAI_API_KEY will do)"
            ) from error
        self._failures = (openai.OpenAIError, ValueError)
        self.settings, self.statistics, self._lock = settings, statistics, threading.Lock()
        statistics.update({name: statistics.get(name, 0) for name in COUNTS})

    def __call__(self, scene: TensorDictBase, world: World, settings: FeasibilitySettings) -> Feasibility:
        """Feasible vehicles of scenes [B]: the model's three criteria where it answers, the rules' otherwise. The
        conflict table is always the rules', and so is that neither the ego nor parked vehicles are feasible."""
        rules = feasible_vehicles(scene, world, settings)
        verdicts = self.judge(scene, world, rules)
        criteria = torch.stack([rules.associated, rules.conflicting, rules.relevant], -1).cpu()
        for row, found in enumerate(verdicts):
            if found:
                criteria[row, list(found)] = torch.tensor(list(found.values()))
        criteria = criteria.to(rules.mask.device)
        vehicles = rules.mask.shape[1]
        mask = criteria.all(-1) & world.valid[:, :vehicles] & ~scene["parked"][:, :vehicles]
        mask[:, 0] = False
        associated, conflicting, relevant = criteria.unbind(-1)
        return replace(rules, mask=mask, associated=associated, conflicting=conflicting, relevant=relevant)

    def judge(self, scene: TensorDictBase, world: World, rules: Feasibility) -> list[Verdicts | None]:
        """Per scene [B] the model's verdicts ({} where there is nobody to ask about), or None where it failed."""
        asked = []
        for row in range(len(world.step)):
            present = present_vehicles(scene, world, row)
            texts = {vehicle: describe_vehicle(scene, world, rules, row, vehicle) for vehicle in present}
            asked.append((describe_ego(scene, world, row), texts))
        with ThreadPoolExecutor(self.settings.workers) as pool:
            return list(pool.map(lambda scene_text: self._verdicts(*scene_text), asked))

    def _verdicts(self, ego: str, vehicles: dict[int, str]) -> Verdicts | None:
        if not vehicles:
            return {}
        self._count("lm_scenes")
        chat = messages(ego, vehicles)
        path = self._path(chat)
        try:
            if path.is_file():
                found = read_answer(path.read_text(), list(vehicles))
                self._count("lm_cached")
                return found
        except (OSError, ValueError):
            path.unlink(missing_ok=True)  # damaged: ask again
        try:
            self._count("lm_requests")
            answer = self._ask(chat)
            found = read_answer(answer, list(vehicles))
        except self._failures as error:
            self._fell_back(error)
            return None
        _write(path, answer)
        return found

    def _ask(self, chat: list[dict[str, str]]) -> str:
        done = self._client.chat.completions.create(
            model=self.settings.model, messages=chat, temperature=0, response_format=FORMAT
        )
        if not getattr(done, "choices", None) or not done.choices[0].message.content:
            raise ValueError("the endpoint sent no answer")
        return done.choices[0].message.content

    def _path(self, chat: list[dict[str, str]]) -> Path:
        """Where the answer to a chat is kept: by endpoint, model, prompt, description and schema."""
        key = json.dumps([self.settings.base_url, self.settings.model, chat, FORMAT], sort_keys=True)
        return Path(self.settings.cache) / f"{hashlib.sha256(key.encode()).hexdigest()}.json"

    def _count(self, name: str) -> int:
        with self._lock:
            self.statistics[name] += 1
            return int(self.statistics[name])

    def _fell_back(self, error: Exception) -> None:
        count = self._count("lm_fallbacks")
        if str(count).rstrip("0") == "1":
            what = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
            warnings.warn(
                f"language-model reasoner: the rules decided for {count} of "
                f"{self.statistics['lm_scenes']} scenes so far ({what})",
                stacklevel=2,
            )


def _write(path: Path, text: str) -> None:
    """Whole or not at all; InputError where the folder cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=".part-")
        with os.fdopen(handle, "w") as file:
            file.write(text)
        os.replace(name, path)
    except OSError as error:
        raise InputError(
            f"synthesizer.reasoner.cache={path.parent}: cannot be written ({error}); pass a writable folder"
        ) from error
