#!/usr/bin/env bash
# foxglove-sdk's Timestamp.from_epoch_secs and Duration.from_secs cut the nanoseconds of a float, they do not round.
#
# 4.3 s become 4 s and 299,999,999 ns: the double nearest to 4.3 lies a little below it. So it is for almost half of the
# hundredths up to 100 s. A message whose header is made so and whose log_time is the same moment in whole nanoseconds
# has two times, a nanosecond apart, and whoever joins messages by equal stamps misses it. Timestamp.from_datetime keeps
# the moment, and so does Timestamp(sec, nsec). NaN seconds become the time 0, without a word.
# Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q foxglove-sdk==0.30.3
cat > "$folder/program.py" <<'PYTHON'
import sys
from datetime import datetime, timedelta, timezone
from importlib.metadata import version

from foxglove.messages import Duration, Timestamp

BEGIN = datetime(1970, 1, 1, tzinfo=timezone.utc)


def nanoseconds(time):
    return time.sec * 10**9 + time.nsec


print("foxglove-sdk", version("foxglove-sdk"))
print("4.3 s:", Timestamp.from_epoch_secs(4.3), Duration.from_secs(4.3))
exact = [hundredth * 10**7 for hundredth in range(10_000)]
makers = {
    "Timestamp.from_epoch_secs": lambda time: Timestamp.from_epoch_secs(time / 1e9),
    "Duration.from_secs": lambda time: Duration.from_secs(time / 1e9),
    "Timestamp.from_datetime": lambda time: Timestamp.from_datetime(BEGIN + timedelta(microseconds=time // 1000)),
    "Timestamp(sec, nsec)": lambda time: Timestamp(*divmod(time, 10**9)),
}
late = {}
for name, make in makers.items():
    errors = [nanoseconds(make(time)) - time for time in exact]
    late[name] = sum(map(bool, errors))
    print(f"{name}: {late[name]} of {len(exact)} hundredths are off, by {sorted(set(errors))} ns")
nan = Timestamp.from_epoch_secs(float("nan"))
print("NaN seconds:", nan)
cut = late["Timestamp.from_epoch_secs"] > 4000 and late["Duration.from_secs"] > 4000
kept = late["Timestamp.from_datetime"] == late["Timestamp(sec, nsec)"] == 0
sys.exit(0 if cut and kept and nanoseconds(nan) == 0 else 1)
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
