#!/usr/bin/env bash
# The 95% interval that statsmodels gives for a count of zero events is a single point, of which zero is no part.
#
# No crash in 100 hours: confint_poisson of method "midp-c" says 0.03 to 0.03 crashes per hour. Its upper limit is right
# (exp(-100 r) / 2 = 0.025), its lower one should be 0: the search for the rate at which the test rejects finds the upper
# limit from below. confint_poisson_2indep does likewise with its default method "score" as soon as one of the two counts
# is zero: of 0 crashes against 10 in as many hours it gives a ratio of 0.38 to 0.38 where 0 to 0.38 is right, and of 1
# against 0 it gives 0.26 to 0.26 where the upper limit is infinite. Few crashes are what tests of a good driver see, and a
# point looks like certainty. "exact-c" gives 0 to 0.037 for one rate, and "mover" 0 to 0.43 for 0 against 10.
# Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q statsmodels==0.15.0 scipy==1.17.1 numpy==2.4.6 pandas==3.1.1
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys

import numpy
import statsmodels
from statsmodels.stats.rates import confint_poisson, confint_poisson_2indep, test_poisson_2indep

HOURS = 100.0


def shown(interval):
    return f"{interval[0]:.5f} to {interval[1]:.5f}"


def point(interval):
    return abs(interval[1] - interval[0]) < 1e-6


print("statsmodels", statsmodels.__version__)
one = {count: confint_poisson(count, HOURS, method="midp-c") for count in (0, 1, 5)}
for count, interval in one.items():
    exact = confint_poisson(count, HOURS, method="exact-c")
    print(f"{count} events in {HOURS:g} h, rate per hour: midp-c {shown(interval)}, exact-c {shown(exact)}")
upper = numpy.log(0.5 / 0.025) / HOURS
print(f"  the rate at which no event has a mid-p of 2.5%: {upper:.5f}")
two = {}
for first, second in ((0, 10), (1, 0), (10, 0), (5, 10)):
    two[first, second] = score = confint_poisson_2indep(first, HOURS, second, HOURS)
    mover = confint_poisson_2indep(first, HOURS, second, HOURS, method="mover")
    print(f"{first} against {second} events, ratio of rates: score {shown(score)}, mover {shown(mover)}")
below = test_poisson_2indep(0, HOURS, 10, HOURS, value=0.01, method="score").pvalue
print(f"  the score test of a ratio of 0.01 at 0 against 10 events, which the interval excludes: p = {below:.2f}")
points = [point(one[0]), point(two[0, 10]), point(two[1, 0]), point(two[10, 0])]
others = [point(one[1]), point(one[5]), point(two[5, 10])]
sys.exit(0 if all(points) and not any(others) and abs(one[0][1] - upper) < 1e-6 and below > 0.5 else 1)
PYTHON
