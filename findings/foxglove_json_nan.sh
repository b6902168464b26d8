#!/usr/bin/env bash
# A dict with a NaN or an infinity that foxglove-sdk logs on a channel of encoding `json` is written as no JSON.
#
# The message reads {"gap": NaN}. Python's json reads it back, so tests in Python see nothing. orjson, which
# keeps to RFC 8259, refuses all of the message, its good fields too. The SDK says nothing when it writes, though
# it writes layouts with allow_nan=False; in its protobuf schemas NaN is a number. Leave the field out, or write null.
# Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q foxglove-sdk==0.30.3 mcap==1.6.0 orjson==3.11.4
cat > "$folder/program.py" <<'PYTHON'
import json
import sys
from importlib.metadata import version
from pathlib import Path

import orjson
from foxglove import Channel, Context, open_mcap
from foxglove.layouts import Layout, PlotConfig, PlotPanel
from mcap.reader import make_reader

context = Context()
channel = Channel("/motion", schema={"type": "object", "properties": {"gap": {"type": "number"}}}, context=context)
path = Path(sys.argv[1]) / "file.mcap"
VALUES = {"finite": 1.5, "NaN": float("nan"), "infinite": float("inf")}
with open_mcap(path, context=context):
    for time, value in enumerate(VALUES.values()):
        channel.log({"gap": value, "speed": 8.0}, log_time=time)
print("foxglove-sdk", version("foxglove-sdk"), "mcap", version("mcap"), "orjson", orjson.__version__)
refused = []
with path.open("rb") as file:
    for name, (_, channel, message) in zip(VALUES, make_reader(file).iter_messages()):
        json.loads(message.data)
        try:
            orjson.loads(message.data)
            verdict = "read"
        except orjson.JSONDecodeError as error:
            refused.append(name)
            verdict = f"refused: {error}"
        print(f"{name}: {channel.message_encoding} {message.data}, json: read, orjson: {verdict}")
try:
    Layout(content=PlotPanel(config=PlotConfig(max_y_value=float("nan")))).to_json()
    layout = "written"
except ValueError as error:
    layout = f"refused: {error}"
print("a layout with NaN:", layout)
sys.exit(0 if refused == ["NaN", "infinite"] and layout.startswith("refused") else 1)
PYTHON
"$folder/venv/bin/python" "$folder/program.py" "$folder"
