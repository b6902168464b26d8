"""Agreement of two judges as defined, and of the rules with a model that answers over HTTP."""

import json
import math

import pytest
import torch

from e2rl.traffic.e2.feasibility import FeasibilitySettings
from e2rl.traffic.e2.reasoner import CRITERIA, LanguageReasoner, ReasonerSettings
from tests.traffic.e2.chat_server import asked, chat_server
from tests.traffic.e2.traffic_scenes import scenes
from tools.reasoner_agreement import Agreement, agreement_table, measure_agreement


def test_kappa_is_cohen_s():
    found = Agreement(both=20, neither=15, first=5, second=10)  # the textbook example: 0.7 raw, 0.5 by chance
    assert found.raw == pytest.approx(0.7) and found.kappa == pytest.approx(0.4) and found.n == 50
    assert Agreement(4, 6, 0, 0).kappa == 1.0 and math.isnan(Agreement(0, 9, 0, 0).kappa)
    assert math.isnan(Agreement(0, 0, 0, 0).raw)
    yes = torch.tensor([True, True, False, False, True])
    assert Agreement.of(yes, ~yes) == Agreement(0, 0, 3, 2)


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
        reasoner = LanguageReasoner(ReasonerSettings("lm", "small", url, workers=1, cache=str(tmp_path)), {})
        found, compared = measure_agreement(scenes(3), reasoner, FeasibilitySettings())
    assert compared == 2 and set(found) == {"feasible", *CRITERIA} and found["feasible"].n == 8
    assert found["on_lane"].raw == 0.0 and found["on_lane"].first == 8 and found["feasible"].second == 0
    assert "2 of 3 scenes" in agreement_table(found, compared, 3)
