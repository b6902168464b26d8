"""Agreement of two judges as defined, and of the rules with a model that answers over HTTP."""

import json
import math

import pytest
import torch

from e2rl.traffic.e2.feasibility import FeasibilitySettings
from e2rl.traffic.e2.reasoner import CRITERIA, LanguageReasoner, ReasonerSettings
from tests.traffic.e2.chat_server import asked, chat_server
from tests.traffic.e2.traffic_scenes import scenes
from tools.reasoner_agreement import agreement, judged


def test_kappa_is_cohen_s():
    first = torch.tensor([True] * 25 + [False] * 25)  # the textbook example: 20 both, 15 neither, 5 and 10 one only
    second = torch.tensor([True] * 20 + [False] * 5 + [True] * 10 + [False] * 15)
    assert agreement(first, second) == (pytest.approx(0.7), pytest.approx(0.4))
    assert agreement(first, first)[1] == 1.0 and math.isnan(agreement(first[:9], first[:9])[1])
    assert math.isnan(agreement(first[:0], first[:0])[0])


def test_a_contrary_model_and_scenes_without_an_answer(tmp_path, monkeypatch):
    pytest.importorskip("openai")
    monkeypatch.setenv("OPENAI_API_KEY", "any")
    sent = []

    def answer(request):
        sent.append(request)
        if len(sent) == 1:
            return "?"
        return json.dumps({"vehicles": [{"id": number} | dict.fromkeys(CRITERIA, False) for number in asked(request)]})

    with chat_server(answer) as (url, _), pytest.warns(UserWarning):
        settings = ReasonerSettings(kind="lm", model="small", base_url=url, workers=1, cache=str(tmp_path))
        ours, theirs, compared = judged(scenes(3), LanguageReasoner(settings), FeasibilitySettings())
    assert compared == 2 and len(ours) == 8 and not theirs.any()
    assert ours[:, 0].all() and agreement(ours[:, 0], theirs[:, 0])[0] == 0.0
