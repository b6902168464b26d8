"""Scalars land where they belong, in the known groups, and go on after a
resume."""

import json
import math
import sqlite3
import struct
import time
from importlib.util import find_spec

import pytest

from e2rl.learning.logging import CHOICES, RunLogger
from e2rl.run.errors import InputError

WANDB_HEADER = 7  # bytes
LEVELDB_BLOCK = 1 << 15  # bytes
SECONDS = 30  # that wandb has to write
FRAGMENT = struct.Struct("<IHB")


def test_unknown_groups_and_kinds_are_refused(tmp_path):
    with pytest.raises(InputError, match="loss"):
        RunLogger("none", tmp_path).log({"loss": 1.0}, 0)
    with pytest.raises(InputError, match="logger.kind=paper"):
        RunLogger("paper", tmp_path)


def test_what_a_resumed_run_logs_again_is_not_doubled(tmp_path):
    """Also where the run was killed in the midst of a line."""
    RunLogger("csv", tmp_path).log({"train/loss": 0.5, "time/improve": 2.0}, 0)
    RunLogger("csv", tmp_path).log({"train/loss": 0.25, "time/improve": 3.0}, 1)
    with (tmp_path / "logs" / "scalars" / "train" / "loss.csv").open("a") as file:
        file.write("2,0.1")
    logger = RunLogger("csv", tmp_path)
    logger.forget(1)
    logger.log({"train/loss": 0.25, "time/improve": 3.0}, 1)
    scalars = tmp_path / "logs" / "scalars"
    assert (scalars / "train" / "loss.csv").read_text().split() == ["0,0.5", "1,0.25"]
    assert (scalars / "time" / "improve.csv").read_text().split() == ["0,2.0", "1,3.0"]


def test_the_table_of_choices_goes_on_where_a_round_is_logged_again(tmp_path):
    logger = RunLogger("csv", tmp_path)
    for number in (0, 1, 1):
        logger.log({}, number, [{"round": number, "eta": 0.5, "rate": math.nan}])
    lines = (tmp_path / CHOICES).read_text().splitlines()
    assert lines == ["round,eta,rate", "0,0.5,", "1,0.5,"], "NaN is empty"


def test_wandb_has_scalars_of_a_step_in_one_row(tmp_path, monkeypatch):
    """Two rounds, read back from the file of the
    offline run."""
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_SILENT", "true")
    logger = RunLogger("wandb", tmp_path)
    for number in range(2):
        logger.log(
            {
                "train/return": 1.5 + number,
                "time/improve": 2.0,
                "train/unknown": math.nan,
            },
            number,
        )
    logger.close()
    (file,) = tmp_path.rglob("run-*.wandb")
    for _ in range(SECONDS):  # wandb's own process may write after finish() returns
        rows = history(file)
        if len(rows) == 2:
            break
        time.sleep(1)
    assert [row["_step"] for row in rows] == [0, 1]
    assert [row["train/return"] for row in rows] == [1.5, 2.5]
    assert all("train/unknown" not in row for row in rows)


def test_trackio_has_the_scalars_in_the_folder_of_the_run(tmp_path, monkeypatch):
    """Read back from its database."""
    if find_spec("trackio") is None:  # it reads its folder as it is imported
        pytest.skip("trackio is not installed")
    monkeypatch.setenv("TRACKIO_DIR", "")  # given back afterwards
    logger = RunLogger("trackio", tmp_path)
    for number in range(2):
        logger.log({"train/return": 1.5 + number, "train/unknown": math.nan}, number)
    logger.close()
    with sqlite3.connect(tmp_path / "trackio" / "e2rl.db") as database:
        rows = database.execute("SELECT step, metrics FROM metrics").fetchall()
    values = [(step, json.loads(metrics)) for step, metrics in rows]
    assert values == [(0, {"train/return": 1.5}), (1, {"train/return": 2.5})]


def history(file):
    """The rows {name: value} of an offline run. Its file is a log of LevelDB, whose
    records are messages of wandb's."""
    from wandb.proto.wandb_internal_pb2 import Record

    rows = []
    for content in leveldb_records(file.read_bytes()[WANDB_HEADER:]):
        record = Record.FromString(content)
        if record.WhichOneof("record_type") == "history":
            items = record.history.item
            rows.append(
                {
                    "/".join(item.nested_key) or item.key: json.loads(item.value_json)
                    for item in items
                }
            )
    return rows


def leveldb_records(content):
    """Records of a LevelDB log: fragments of crc, length and kind (1 whole, 2 first, 3
    middle, 4 last), none of which crosses a block. The first block has a header of
    WANDB_HEADER bytes."""
    at = 0
    record = b""
    while at + FRAGMENT.size <= len(content):
        left = LEVELDB_BLOCK - (at + WANDB_HEADER) % LEVELDB_BLOCK
        if left < FRAGMENT.size:
            at += left
            continue
        _, length, kind = FRAGMENT.unpack_from(content, at)
        at += FRAGMENT.size
        record += content[at : at + length]
        at += length
        if kind in (1, 4):
            yield record
            record = b""
