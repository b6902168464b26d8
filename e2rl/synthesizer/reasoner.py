"""Who applies the criteria of Sec. IV-A2: the rules of feasibility.py, or a language model in their place.

The model is asked about all vehicles of a scene in one request, and about the scenes of a batch in parallel. Answers
are cached on disk by content. Where a request fails, the rules decide for that scene, and this is counted.
"""

import hashlib
import json
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from e2rl.errors import InputError
from e2rl.files import write_atomically
from e2rl.settings import check_choice, check_range
from e2rl.sim.world import World
from e2rl.synthesizer.description import describe
from e2rl.synthesizer.feasibility import Feasibility, FeasibilitySettings, feasible_vehicles
from e2rl.synthesizer.prompt import SCHEMA, Verdicts, messages, read_answer

FORMAT = {"type": "json_schema", "json_schema": {"name": "feasibility", "strict": True, "schema": SCHEMA}}
COUNTS = ("lm_scenes", "lm_requests", "lm_cached", "lm_fallbacks")
Reasoner = Callable[[TensorDictBase, World, FeasibilitySettings], Feasibility]


@dataclass(frozen=True)
class ReasonerSettings:
    """Settings of the reasoner; conf/synthesizer/e2.yaml explains each."""

    kind: str = "rules"
    model: str | None = None
    base_url: str | None = None
    timeout: float = 30.0
    retries: int = 1
    workers: int = 8
    cache: str = ".cache/reasoner"

    def __post_init__(self) -> None:
        check_choice("synthesizer.reasoner.kind", self.kind, ("rules", "lm"))
        for name, low in (("timeout", 1e-3), ("retries", 0), ("workers", 1)):
            check_range(f"synthesizer.reasoner.{name}", getattr(self, name), low)
        if self.kind == "lm" and not self.model:
            raise InputError("synthesizer.reasoner.kind=lm: name a model with synthesizer.reasoner.model=NAME")


def build_reasoner(settings: ReasonerSettings, statistics: dict[str, float]) -> Reasoner:
    """The rules, or a LanguageReasoner that counts in `statistics`."""
    return feasible_vehicles if settings.kind == "rules" else LanguageReasoner(settings, statistics)


class LanguageReasoner:
    """Asks an OpenAI-compatible endpoint; called as `feasible_vehicles` is.

    statistics: lm_scenes judged, lm_requests sent, lm_cached answers, lm_fallbacks (scenes that the rules decided).
    Warns of the 1st, 10th, 100th, ... fallback. Raises InputError without the client, a key or a writable cache.
    """

    def __init__(self, settings: ReasonerSettings, statistics: dict[str, float]) -> None:
        where = "synthesizer.reasoner.kind=lm"
        try:
            import openai
        except ImportError as error:
            reason = "the openai client is not installed; install e2rl with its extra: pip install 'e2rl[lm]'"
            raise InputError(f"{where}: {reason}") from error
        base_url, timeout = settings.base_url, settings.timeout
        try:
            self._client = openai.OpenAI(base_url=base_url, timeout=timeout, max_retries=settings.retries)
        except openai.OpenAIError as error:
            reason = f"{str(error).splitlines()[0]} (for an endpoint without keys any OPENAI_API_KEY will do)"
            raise InputError(f"{where}: {reason}") from error
        self._failures = (openai.OpenAIError, ValueError)
        self.settings, self.statistics, self._lock = settings, statistics, threading.Lock()
        statistics.update({name: statistics.get(name, 0) for name in COUNTS})

    def __call__(self, scene: TensorDictBase, world: World, settings: FeasibilitySettings) -> Feasibility:
        """Feasible vehicles of scenes [B]: by the model's verdicts on the three criteria, or the rules' where it fails.

        The conflict points are always the rules', and neither the ego nor parked vehicles are ever feasible.
        """
        rules = feasible_vehicles(scene, world, settings)
        criteria = torch.stack([rules.associated, rules.conflicting, rules.relevant], -1).cpu()
        for row, verdicts in enumerate(self.judge(scene, world, rules)):
            if verdicts:
                criteria[row, list(verdicts)] = torch.tensor(list(verdicts.values()))
        criteria = criteria.to(rules.mask.device)
        vehicles = rules.mask.shape[1]
        mask = criteria.all(-1) & world.valid[:, :vehicles] & ~scene["parked"][:, :vehicles]
        mask[:, 0] = False
        associated, conflicting, relevant = criteria.unbind(-1)
        return replace(rules, mask=mask, associated=associated, conflicting=conflicting, relevant=relevant)

    def judge(self, scene: TensorDictBase, world: World, rules: Feasibility) -> list[Verdicts | None]:
        """Per scene [B] the model's verdicts ({} where there is nobody to ask about), or None where it failed."""
        described = [describe(scene, world, rules.conflicts, row) for row in range(len(world.step))]
        with ThreadPoolExecutor(self.settings.workers) as pool:
            return list(pool.map(self._verdicts, *zip(*described, strict=True)))

    def _verdicts(self, ego: str, vehicles: dict[int, str]) -> Verdicts | None:
        """Verdicts on one scene, from the cache or the endpoint."""
        if not vehicles:
            return {}
        self._count("lm_scenes")
        chat = messages(ego, vehicles)
        path = self._path(chat)
        with suppress(OSError, ValueError):  # no answer yet, or a damaged one: ask
            verdicts = read_answer(path.read_text(), list(vehicles))
            self._count("lm_cached")
            return verdicts
        try:
            self._count("lm_requests")
            answer = self._ask(chat)
            verdicts = read_answer(answer, list(vehicles))
        except self._failures as error:
            self._fell_back(error)
            return None
        try:
            write_atomically(path, answer)
        except OSError as error:
            where = f"synthesizer.reasoner.cache={path.parent}"
            raise InputError(f"{where}: cannot be written ({error}); pass a writable folder") from error
        return verdicts

    def _ask(self, chat: list[dict[str, str]]) -> str:
        request: dict[str, Any] = {"model": self.settings.model, "messages": chat, "response_format": FORMAT}
        completion = self._client.chat.completions.create(**request, temperature=0)
        if not getattr(completion, "choices", None) or not completion.choices[0].message.content:
            raise ValueError("the endpoint sent no answer")
        return completion.choices[0].message.content

    def _path(self, chat: list[dict[str, str]]) -> Path:
        """The cache file of a chat: by endpoint, model, prompt, description and schema."""
        key = json.dumps([self.settings.base_url, self.settings.model, chat, FORMAT], sort_keys=True)
        return Path(self.settings.cache) / f"{hashlib.sha256(key.encode()).hexdigest()}.json"

    def _count(self, name: str) -> int:
        with self._lock:
            self.statistics[name] += 1
            return int(self.statistics[name])

    def _fell_back(self, error: Exception) -> None:
        count = self._count("lm_fallbacks")
        if str(count).rstrip("0") == "1":
            reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
            scenes = f"{count} of {self.statistics['lm_scenes']} scenes so far"
            warnings.warn(f"language-model reasoner: the rules decided for {scenes} ({reason})", stacklevel=2)
