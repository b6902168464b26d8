#!/usr/bin/env bash
# The same seconds are other moments in rerun-sdk if they come as a numpy array and not as a list.
#
# TimeColumn(duration=ARRAY) multiplies by 1e9 and cuts; TimeColumn(duration=LIST) and set_time round. 2.01 s are
# 2,009,999,999 ns by the array. So it is for one hundredth in 45, and for a third of all steps of 1/30 s. An entity
# that send_columns writes and one that log writes at the same step are a nanosecond apart: a query at the moment of the
# one sees the step before of the other, and a table by time has two rows with holes. numpy.timedelta64 is exact in both.
# timestamp= does likewise. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q rerun-sdk==0.41.0 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import sys
from pathlib import Path

import numpy
import rerun
from rerun.chunk import RrdReader

path = Path(sys.argv[1]) / "file.rrd"
print("rerun-sdk", rerun.__version__, "numpy", numpy.__version__)


def times(seconds, kind="duration"):
    """In whole nanoseconds."""
    return rerun.TimeColumn("time", **{kind: seconds}).as_arrow_array().cast("int64").to_numpy()


shares = {}
for name, seconds in (("k / 100", numpy.arange(10_000) / 100), ("k / 30", numpy.arange(10_000) / 30)):
    exact = numpy.rint(seconds * 1e9).astype("int64")
    for kind in ("duration", "timestamp"):
        assert (times(seconds.tolist(), kind) == exact).all()
        difference = times(seconds, kind) - exact
        shares[name, kind] = (difference != 0).mean()
        print(f"{name}, {kind}: list exact; array off in {shares[name, kind]:.1%}, by {numpy.unique(difference)} ns")
    assert (times(exact.astype("timedelta64[ns]")) == exact).all()

seconds = [2.00, 2.01, 2.02]
stream = rerun.RecordingStream("application", recording_id="recording")
stream.save(path)
index = rerun.TimeColumn("time", duration=numpy.array(seconds))
stream.send_columns("columns", indexes=[index], columns=rerun.Scalars.columns(scalars=[0.0, 1.0, 2.0]))
for value, second in enumerate(seconds):
    stream.set_time("time", duration=second)
    stream.log("log", rerun.Scalars(value))
stream.flush()
stream.disconnect()
written = {}
for chunk in RrdReader(path).stream().to_chunks():
    if "time" in chunk.timeline_names:
        batch = chunk.to_record_batch()
        written.setdefault(chunk.entity_path, []).extend(batch.column("time").cast("int64").to_pylist())
print("2, 2.01 and 2.02 s in a file:", written)
apart = written["/columns"][1] - written["/log"][1]
sys.exit(0 if apart == -1 and min(shares.values()) > 0.01 and shares["k / 30", "duration"] > 0.25 else 1)
PYTHON
"$folder/venv/bin/python" "$folder/program.py" "$folder"
