#!/usr/bin/env bash
# TorchRL's WandbLogger takes a step for each scalar, and hands wandb none. It writes the step as a scalar of its own
# beside the value (train/step), and wandb numbers the rows as they come: three scalars of step 0 are rows 0, 1 and 2.
# A picture that is then logged by wandb's own call at the same step 0 goes to a row that is written already. wandb
# drops it with a warning on stderr; the file lies on disk, and no row of the history names it.
# With override_global_step=True the scalars and the picture share a row.
#
# Exits 0 while this is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 wandb==0.31.0 numpy==2.4.6 pillow
cd "$folder"
cat > program.py <<'PYTHON'
import json
import struct
import sys
from importlib.metadata import version
from pathlib import Path

import wandb
from PIL import Image
from torchrl.record.loggers import WandbLogger
from wandb.proto.wandb_internal_pb2 import Record


def rows(folder):
    """The history rows of an offline run, whose file is a log of LevelDB after 7 bytes; it has less than a block."""
    (file,) = Path(folder).rglob("run-*.wandb")
    content, at, found = file.read_bytes(), 7, []
    while at + 7 <= len(content):
        _, length, _ = struct.unpack_from("<IHB", content, at)
        record = Record.FromString(content[at + 7 : at + 7 + length])
        at += 7 + length
        if record.WhichOneof("record_type") == "history":
            items = {"/".join(item.nested_key) or item.key: json.loads(item.value_json) for item in record.history.item}
            found.append({name: value for name, value in items.items() if name in ("_step", "picture/path") or "/" in name})
    return found


def logged(folder, **options):
    """Two scalars of step 0, then a picture of step 0."""
    logger = WandbLogger("run", offline=True, save_dir=folder, project="p", log_env_packages=False)
    for name in ("train/loss", "train/return", "eval/return"):
        logger.log_scalar(name, 1.0, step=0, **options)
    logger.experiment.log({"picture": wandb.Image(Image.new("RGB", (4, 4)))}, step=0)
    logger.experiment.finish()
    return rows(folder)


print("torchrl", version("torchrl"), "wandb", wandb.__version__)
plain = logged("plain")
shared = logged("shared", commit=False, override_global_step=True)
for name, found in (("log_scalar(step=0)", plain), ("with override_global_step", shared)):
    print(name)
    for row in found:
        print("   ", row)
lost = [row["_step"] for row in plain] == [0, 1, 2] and not any("picture/path" in row for row in plain)
kept = [row["_step"] for row in shared] == [0] and "picture/path" in shared[0]
sys.exit(0 if lost and kept else 1)
PYTHON
WANDB_SILENT=true "$folder/venv/bin/python" program.py
