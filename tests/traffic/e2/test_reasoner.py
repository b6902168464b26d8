"""The language-model reasoner against a real HTTP server: answers count, failures leave
it to the rules, audibly."""

import json
import math
import re
import threading
import time
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
import torch

from e2rl.traffic.e2.feasibility import FeasibilitySettings, feasible_vehicles
from e2rl.traffic.e2.reasoner import (
    CRITERIA,
    LanguageReasoner,
    ReasonerSettings,
    read_answer,
)
from tests.traffic.e2.crossing import make_world

pytest.importorskip("openai")
RULES = FeasibilitySettings()
UP = math.pi / 2


def asked(request: dict) -> list[int]:
    """Numbers of the vehicles that a request asks about."""
    return [
        int(number)
        for number in re.findall(
            r"\d+", request["messages"][-1]["content"].rsplit("Judge", 1)[1]
        )
    ]


def verdicts(request: dict, value=True) -> str:
    """The answer that gives all vehicles the same verdict."""
    return json.dumps(
        {
            "vehicles": [
                {"id": number} | dict.fromkeys(CRITERIA, value)
                for number in asked(request)
            ]
        }
    )


@contextmanager
def chat_server(answer):
    """(base URL, requests received) of a server whose answer(request) -> the message's
    text, or (status, text)."""
    requests = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):  # noqa: N802 (the name is http.server's)
            request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            requests.append(request | {"path": self.path})
            inputs = answer(request)
            status, text = inputs if isinstance(inputs, tuple) else (200, inputs)
            choice = {
                "index": 0,
                "finish_reason": "stop",
                "message": {"role": "assistant", "content": text},
            }
            named = {
                "id": "1",
                "object": "chat.completion",
                "created": int(time.time()),
                "model": "small",
            }
            body = json.dumps(named | {"choices": [choice]}).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            with suppress(OSError):  # the client may have given up
                self.wfile.write(body)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(
        target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True
    )
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/v1", requests
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture(autouse=True)
def key(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "any")


def world(copies=1):
    """The ego and two vehicles: the first crosses its way, the second never meets it."""
    built = make_world(
        [(0.0, 0.0, 0.0, 10.0), (50.0, -40.0, UP, 10.0), (0.0, 12.0, 0.0, 10.0)],
        copies=copies,
    )
    built.states[:, 1, 3] += torch.arange(copies)  # scenes that differ
    return built


def ask(url, tmp_path, made, **settings):
    reasoner = LanguageReasoner(
        ReasonerSettings(
            **(
                {
                    "kind": "lm",
                    "model": "small",
                    "base_url": url,
                    "retries": 0,
                    "cache": str(tmp_path),
                }
                | settings
            )
        )
    )
    return reasoner(made.scene, made, RULES), reasoner.statistics


def test_the_model_decides_and_is_asked_by_schema_at_temperature_zero(tmp_path):
    with chat_server(verdicts) as (url, requests):
        result, counts = ask(url, tmp_path, made=world())
    assert result.mask[0].tolist() == [False, True, True] + [False] * 5, (
        "the rules would take the first only"
    )
    request = requests[0]
    assert request["path"] == "/v1/chat/completions"
    assert request["temperature"] == 0
    assert request["model"] == "small"
    schema = request["response_format"]["json_schema"]
    assert schema["strict"]
    assert schema["schema"]["properties"]["vehicles"]["items"]["required"] == [
        "id",
        *CRITERIA,
    ]
    text = request["messages"][-1]["content"]
    assert "50 m ahead of it and 40 m to its right" in text
    assert "Feasible" not in text, "the rules' verdict is not told"
    assert counts == {
        "lm_scenes": 1,
        "lm_requests": 1,
        "lm_cached": 0,
        "lm_fallbacks": 0,
    }


def test_the_conflict_table_stays_and_parked_vehicles_are_not_asked_about(tmp_path):
    built = world()
    built.scene["parked"][:, 2] = True
    with chat_server(verdicts) as (url, requests):
        result, _ = ask(url, tmp_path, made=built)
    assert result.mask[0].tolist() == [False, True] + [False] * 6
    assert "Vehicle 2" not in requests[0]["messages"][-1]["content"]
    torch.testing.assert_close(
        result.conflicts.s,
        feasible_vehicles(built.scene, built, settings=RULES).conflicts.s,
    )


@pytest.mark.parametrize(
    "answer",
    [
        "no JSON at all",
        "[]",
        "[" * 100_000,
        '{"vehicles": [{"id": 1}]}',
        json.dumps(
            {
                "vehicles": [
                    {"id": number} | dict.fromkeys(CRITERIA, True) for number in (1, 7)
                ]
            }
        ),
        json.dumps({"vehicles": [{"id": 1} | dict.fromkeys(CRITERIA, True)]}),
        json.dumps(
            {
                "vehicles": [
                    {"id": number} | dict.fromkeys(CRITERIA, "yes") for number in (1, 2)
                ]
            }
        ),
        (500, "out of order"),
        (404, "no such model"),
        "",
    ],
)
def test_the_rules_decide_where_the_model_fails(tmp_path, answer):
    built = world(2)
    with (
        chat_server(lambda request: answer) as (url, _),
        pytest.warns(UserWarning, match="rules decided for 1 of"),
    ):
        result, counts = ask(url, tmp_path, made=built)
    assert torch.equal(
        result.mask, feasible_vehicles(built.scene, built, settings=RULES).mask
    )
    assert counts["lm_fallbacks"] == counts["lm_requests"] == 2
    assert not list(tmp_path.iterdir()), "failures are not kept"


def test_answers_are_kept_by_content(tmp_path):
    with chat_server(verdicts) as (url, requests):
        first, _ = ask(url, tmp_path, made=world())
        again, counts = ask(url, tmp_path, made=world())
        assert len(requests) == 1
        assert counts["lm_cached"] == 1
        assert torch.equal(first.mask, again.mask)
        ask(url, tmp_path, made=world(), model="other")
        assert len(requests) == 2, "another model is asked anew"
        moved = world()
        moved.states[:, 1, 0] += 5
        ask(url, tmp_path, made=moved)
        assert len(requests) == 3, "and so is about another scene"
        for path in tmp_path.iterdir():
            path.write_text("{")
        ask(url, tmp_path, made=world())
        assert len(requests) == 4, "damaged answers are not believed"


def test_answers_must_be_about_whom_was_asked():
    entry = {"id": 3} | dict.fromkeys(CRITERIA, False)
    assert read_answer(json.dumps({"vehicles": [entry]}), [3]) == {
        3: (False, False, False)
    }
    with pytest.raises(ValueError, match="asked was about"):
        read_answer(json.dumps({"vehicles": [entry, entry]}), [3])
