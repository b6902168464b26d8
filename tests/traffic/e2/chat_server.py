"""A local endpoint that speaks the chat-completions protocol and answers as told."""

import json
import re
import threading
import time
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from e2rl.traffic.e2.reasoner import CRITERIA


def asked(request: dict) -> list[int]:
    """Numbers of the vehicles that a request asks about."""
    return [int(number) for number in re.findall(r"\d+", request["messages"][-1]["content"].rsplit("Judge", 1)[1])]


def verdicts(request: dict, value=True) -> str:
    """The answer that gives all vehicles the same verdict."""
    return json.dumps({"vehicles": [{"id": number} | dict.fromkeys(CRITERIA, value) for number in asked(request)]})


@contextmanager
def chat_server(answer):
    """(base URL, requests received) of a server whose answer(request) -> the message's text, or (status, text)."""
    requests = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):  # noqa: N802 (the name is http.server's)
            request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            requests.append(request | {"path": self.path})
            given = answer(request)
            status, text = given if isinstance(given, tuple) else (200, given)
            choice = {"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": text}}
            named = {"id": "1", "object": "chat.completion", "created": int(time.time()), "model": "small"}
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
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/v1", requests
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
